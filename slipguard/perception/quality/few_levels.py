"""Whether a picture has so few grey levels that edges between them show, which stay while the contact turns."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

EVERY_PX = 4
"""Every so many rows and columns are looked at."""
HELD_PX = 5
"""A level counts where this many of the 4,800 pixels looked at have it: hot pixels fill no gap."""
COARSE_STEP = 12.0
"""Grey levels between neighbouring levels in use, on average: 1.0-1.8 in real gels and in 60 rendered units with little
noise and much, 6 where four times as bright a light has clipped most of it; 32, and at times 16, holds turns back."""


def few_levels(image: NDArray[np.uint8]) -> bool:
    """Whether the green of a picture, (320, 240, 3) uint8 BGR, comes in steps of more than `COARSE_STEP`."""
    return level_step(image[::EVERY_PX, ::EVERY_PX, 1]) > COARSE_STEP


def level_step(levels: NDArray[np.uint8]) -> float:
    """Mean distance of neighbouring grey levels in use; 0 where there are not two. levels: (n, m) uint8."""
    used = np.flatnonzero(np.bincount(levels.ravel(), minlength=256) >= HELD_PX)
    return 0.0 if len(used) < 2 else float(used[-1] - used[0]) / (len(used) - 1)
