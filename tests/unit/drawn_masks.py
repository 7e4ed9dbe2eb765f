"""Anti-aliased masks of known pose, as a network would see them: 120 x 160, soft and uneven borders."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

WIDTH, HEIGHT = 120, 160


def drawn(
    shape: str,
    angle_deg: float = 0.0,
    center: tuple[float, float] = (60.0, 80.0),
    scale: float = 1.0,
    ragged_px: float = 0.0,
    seed: int = 0,
) -> NDArray[np.float32]:
    """Probability (160, 120) float32 of a shape rotated counter-clockwise about its own origin.

    center: network pixels, right and down. ragged_px: standard deviation of the outline's place.
    """
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH].astype(np.float64)
    dx, dy = x - center[0], center[1] - y
    c, s = math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))
    u, v = (dx * c + dy * s) / scale, (dy * c - dx * s) / scale
    outside_px = _SHAPES[shape](u, v) * scale
    if ragged_px:
        rng = np.random.default_rng(seed)
        rough = cv2.GaussianBlur(rng.standard_normal((HEIGHT, WIDTH)), (0, 0), 2.5)
        outside_px = outside_px + ragged_px * rough / rough.std()
    return (1.0 / (1.0 + np.exp(np.clip(outside_px / 0.6, -30, 30)))).astype(np.float32)


def _box(u: NDArray[np.float64], v: NDArray[np.float64], a: float, b: float) -> NDArray[np.float64]:
    qx, qy = np.abs(u) - a, np.abs(v) - b
    return np.minimum(np.maximum(qx, qy), 0.0) + np.hypot(np.maximum(qx, 0.0), np.maximum(qy, 0.0))


_SHAPES = {
    "bar": lambda u, v: _box(u, v, 40, 11),
    "rectangle": lambda u, v: _box(u, v, 30, 20),
    "long bar": lambda u, v: _box(u, v, 200, 12),
    "square": lambda u, v: _box(u, v, 22, 22),
    "ellipse": lambda u, v: (np.hypot(u / 38, v / 20) - 1.0) * 26,
    "disc": lambda u, v: np.hypot(u, v) - 26,
    "ring": lambda u, v: np.abs(np.hypot(u, v) - 26) - 6,
    "wedge": lambda u, v: np.maximum(np.abs(v) - (0.22 * u + 12), np.abs(u) - 36),
    "key": lambda u, v: np.minimum(np.hypot(u + 24, v) - 14, _box(u - 14, v, 28, 5)),
    "cross": lambda u, v: np.minimum(_box(u, v, 40, 8), _box(u, v, 8, 26)),
}
SHAPES = tuple(_SHAPES)
