"""An estimate of the background image from one frame, if the unit's own background image is unknown."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

ORDER = 4
"""Degree of the polynomial: the glow of three lamps on a dome, and little of any imprint."""
ITERATIONS = 6
GRID_WIDTH_PX, GRID_HEIGHT_PX = 30, 40
OUTLIER_FLOOR_LEVELS = 4.0
"""Residuals below this many gray levels (over B, G and R together) do not count as an imprint."""


def _terms(width_px: int, height_px: int) -> NDArray[np.float64]:
    """Return monomials x^i y^j with i + j <= ORDER on an image spanning -1..1: (height * width, 15)."""
    y, x = np.mgrid[0:height_px, 0:width_px]
    x = ((x + 0.5) / width_px * 2.0 - 1.0).ravel()
    y = ((y + 0.5) / height_px * 2.0 - 1.0).ravel()
    return np.stack([x**i * y**j for i in range(ORDER + 1) for j in range(ORDER + 1 - i)], -1)


@cache
def _bases(width_px: int, height_px: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the terms, orthonormal on the fitting grid: on that grid, and at full size."""
    basis, triangle = np.linalg.qr(_terms(GRID_WIDTH_PX, GRID_HEIGHT_PX))
    full = _terms(width_px, height_px) @ np.linalg.inv(triangle)
    return basis.astype(np.float32), full.astype(np.float32)


def estimate_background(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return a smooth image that follows the gel's own glow and passes under the imprint.

    A quartic is fitted to each channel by least squares with weights 1 / (1 + (r / k)^4), where r is the residual over
    the channels and k is 1.5 times its median: an imprint on less than half of the image is left out. Streaks, dust and
    edges of the glow are not modeled, so the network sees them as differences: the unit's own background image is
    better.

    Args:
        image: (H, W, 3) uint8 BGR.

    Returns:
        The background, same shape and type.
    """
    height, width = image.shape[:2]
    basis, full = _bases(width, height)
    coarse = cv2.resize(image, (GRID_WIDTH_PX, GRID_HEIGHT_PX), interpolation=cv2.INTER_AREA)
    levels = coarse.reshape(-1, 3).astype(np.float32)
    weights = np.ones(len(levels), np.float32)
    ridge = 1e-4 * np.eye(basis.shape[1], dtype=np.float32)
    fit = np.zeros((basis.shape[1], 3), np.float32)
    for _ in range(ITERATIONS):
        weighted = basis * weights[:, None]
        fit = np.linalg.solve(basis.T @ weighted + ridge, weighted.T @ levels).astype(np.float32)
        residual = levels - basis @ fit
        distance = np.sqrt(np.einsum("ij,ij->i", residual, residual))
        scale = max(1.5 * float(np.median(distance)), OUTLIER_FLOOR_LEVELS)
        weights = (1.0 / (1.0 + (distance / scale) ** 4)).astype(np.float32)
    smooth = np.clip(full @ fit, 0.0, 255.0)
    return np.asarray(smooth.reshape(height, width, 3), np.uint8)
