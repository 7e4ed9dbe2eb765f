"""Masks that are hard for estimators, by name."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Mask = NDArray[np.uint8]
WIDTH, HEIGHT = 120, 160


def degenerate_masks() -> dict[str, Mask]:
    """Return masks by name: (160, 120) uint8, 0 or 1."""
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH]
    r = np.hypot(x - 60.0, y - 80.0)
    whole = slice(None)
    masks = {
        "empty": _at(),
        "full": _at((whole, whole)),
        "one pixel": _at((80, 60)),
        "pixel in the corner": _at((0, 0)),
        "two far pixels": _at((0, 0), (159, 119)),
        "two pixels, corner to corner": _at((80, 60), (81, 61)),
        "four corners": _at((0, 0), (0, -1), (-1, 0), (-1, -1)),
        "40 pixels": _at((slice(80, 84), slice(50, 60))),
        "50 pixels": _at((slice(80, 85), slice(50, 60))),
        "row": _at((80, whole)),
        "column": _at((whole, 60)),
        "two rows": _at((slice(80, 82), whole)),
        "frame's border": _at((0, whole), (-1, whole), (whole, 0), (whole, -1)),
        "crosshairs": _at((80, whole), (whole, 60)),
        "diagonal": cv2.line(_at(), (0, 0), (119, 159), 1, 1),
        "thick diagonal": cv2.line(_at(), (0, 0), (119, 159), 1, 3),
        "checkerboard": (x + y) % 2,
        "coarse checkerboard": (x // 7 + y // 7) % 2,
        "oblique stripes": (x + 2 * y) // 9 % 2,
        "grid of dots": (x % 2 == 0) & (y % 2 == 0),
        "grid of blobs": (x % 10 < 6) & (y % 10 < 6),
        "comb": (y > 120) | (x % 2 == 0),
        "spiral": (np.sin(r / 2.5 + np.arctan2(y - 80.0, x - 60.0)) > 0.3) & (r < 55),
        "rings": (r.astype(int) // 4) % 2,
        "full but the border": _at((slice(1, -1), slice(1, -1))),
        "left half": _at((whole, slice(0, 60))),
        "quarter in the corner": _at((slice(0, 80), slice(0, 60))),
        "square": _at((slice(60, 100), slice(40, 80))),
        "disc": cv2.circle(_at(), (60, 80), 30, 1, -1),
        "half disc at the edge": cv2.circle(_at(), (0, 80), 30, 1, -1),
        "thin ring": cv2.circle(_at(), (60, 80), 40, 1, 1),
        "bar across the frame": _at((slice(70, 90), whole)),
        "bar along the edge": _at((slice(20, 140), slice(0, 8))),
        "cross": _at((slice(70, 90), slice(20, 100)), (slice(40, 120), slice(50, 70))),
        "two equal solids": _at((slice(20, 50), slice(20, 50)), (slice(110, 140), slice(70, 100))),
        "solid and fragments": _at((slice(40, 90), slice(40, 60)), *[(k, k) for k in range(100, 119, 3)]),
    }
    return {name: np.asarray(mask, np.uint8) for name, mask in masks.items()}


def _at(*places: tuple[slice | int, slice | int]) -> Mask:
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    for rows, columns in places:
        mask[rows, columns] = 1
    return mask
