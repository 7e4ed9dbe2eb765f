"""A first guess of the pressed region from the difference to the no-contact image, for a person to correct."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.sim.contact_label import outlined
from slipguard.sim.raster import f32

Image = NDArray[np.uint8]

SMOOTHING_PX = 3.0
CHANGED_LEVELS = 9.0
"""Grey levels, the largest of the three channels, smoothed. Noise of 3 levels leaves 0.3 of them."""
CHANGED_SHARE = 0.3
"""Of the strongest change in the picture; the glow around a press is weaker. Chosen on real presses."""
STRONGEST_QUANTILE = 0.99
DRIFT_ORDER = 2
DRIFT_ROUNDS = 4
DRIFT_FLOOR_LEVELS = 3.0
SMALLEST_PX = 250
"""0.7 mm2: smaller spots are dust and reflections."""
LABEL_NAME = f"proposed:|frame-no_contact|>{CHANGED_LEVELS:g}"


def propose(image: Image, background: Image) -> NDArray[np.uint8]:
    """The region that differs from the no-contact image, (320, 240) uint8, 0 or 1.

    image, background: (320, 240, 3) uint8 BGR. A slow drift of the light (a quadratic, fitted with little weight on
    what has changed) is taken off first; gaps and holes are closed as in the labels the network learns.
    """
    raw = f32(cv2.GaussianBlur(image.astype(np.float32) - background, (0, 0), SMOOTHING_PX))
    change = raw - _drift(raw)
    strength = np.abs(change).max(axis=2)
    changed = strength > max(CHANGED_LEVELS, CHANGED_SHARE * float(np.quantile(strength, STRONGEST_QUANTILE)))
    count, labels, figures, _ = cv2.connectedComponentsWithStats(changed.astype(np.uint8), connectivity=8)
    keep = [one for one in range(1, count) if figures[one, cv2.CC_STAT_AREA] >= SMALLEST_PX]
    return outlined(np.isin(labels, keep))


def _drift(change: NDArray[np.float32]) -> NDArray[np.float32]:
    """What a slow change of the light adds, (320, 240, 3) float32: a robust fit on a coarse grid."""
    height, width = change.shape[:2]
    coarse = cv2.resize(change, (width // 8, height // 8), interpolation=cv2.INTER_AREA)
    terms = _terms(*coarse.shape[:2])
    levels = coarse.reshape(-1, 3)
    weights = np.ones(len(levels), np.float32)
    fit = np.zeros((terms.shape[1], 3), np.float32)
    for _ in range(DRIFT_ROUNDS):
        fit = np.linalg.lstsq(terms * weights[:, None], levels * weights[:, None], rcond=None)[0]
        distance = np.abs(levels - terms @ fit).max(axis=1)
        weights = 1.0 / (1.0 + (distance / max(float(np.median(distance)), DRIFT_FLOOR_LEVELS)) ** 2)
    return np.asarray((_terms(height, width) @ fit).reshape(height, width, 3), np.float32)


def _terms(height: int, width: int) -> NDArray[np.float32]:
    """Monomials up to DRIFT_ORDER on a picture spanning -1..1, (height * width, 6)."""
    y, x = np.mgrid[0:height, 0:width].astype(np.float32)
    x, y = ((x + 0.5) / width * 2 - 1).ravel(), ((y + 0.5) / height * 2 - 1).ravel()
    powers = [(i, j) for i in range(DRIFT_ORDER + 1) for j in range(DRIFT_ORDER + 1 - i)]
    return np.stack([x**i * y**j for i, j in powers], axis=-1).astype(np.float32)
