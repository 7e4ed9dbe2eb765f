"""Whether a picture is far noisier than any healthy sensor's: what so much noise hides, no sigma tells."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

EVERY_PX = 16
"""Every so many rows are looked along."""
BENT_LEVELS = 16.0
"""Half of all second differences along a row are larger where white noise has a standard deviation of ten grey levels
(1.65 times it, for white noise); 2 in real frames of nine units, and in forty rendered ones. Edges are too few to
count."""


def noisy(image: NDArray[np.uint8]) -> bool:
    """Whether the green of a picture, (320, 240, 3) uint8 BGR, is mostly noise from pixel to pixel."""
    levels = image[::EVERY_PX, :, 1].astype(np.int16)
    bent = np.abs(levels[:, 2:] - 2 * levels[:, 1:-1] + levels[:, :-2]) > BENT_LEVELS
    return bool(2 * np.count_nonzero(bent) > bent.size)
