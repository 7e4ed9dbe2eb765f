"""Whether a picture was compressed so coarsely that its 8 x 8 blocks show, which stay while the contact turns."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

BLOCK_PX = 8
"""Blocks of JPEG and motion JPEG; 240 and 320 are whole numbers of them, however the sensor is mounted."""
EVERY_PX = 4
"""Every so many rows and columns are looked along."""
COARSE_TIMES = 4.0
"""Across the borders of blocks a coarsely compressed picture bends this many times as much as in their middles: 4.3 and
more at JPEG quality 23 on 60 rendered units. Pictures that were never compressed come to 0.7-1.5, of real gels too, and
at the quality of motion JPEG (75 and better) to 3.1 at most; at 60 to 3.7."""
LEAST_LEVELS = 0.05
"""What the middles of blocks count as bent, grey levels, where they are flatter: a picture without any detail."""

Lines = NDArray[np.int16]


def coarsely_compressed(image: NDArray[np.uint8]) -> bool:
    """Whether rows and columns both break at the borders of blocks. image: (320, 240, 3) uint8 BGR."""
    green = image[..., 1]
    if blockiness(green[::EVERY_PX].astype(np.int16)) <= COARSE_TIMES:
        return False
    return blockiness(green[:, ::EVERY_PX].T.astype(np.int16)) > COARSE_TIMES


def blockiness(lines: Lines) -> float:
    """Mean third difference across the borders of blocks over that in their middles; 1 where there are no blocks.

    A third difference is nothing wherever the light changes evenly. lines: (n, m) int16, along the second axis.
    """
    across, inside = _bend(lines, BLOCK_PX - 2), _bend(lines, BLOCK_PX // 2 - 2)
    return across / max(inside, LEAST_LEVELS)


def _bend(lines: Lines, first: int) -> float:
    """Mean third difference, grey levels, of the four pixels from `first` on in every block but the last."""
    end = lines.shape[1] - BLOCK_PX
    a, b, c, d = (lines[:, first + k : end + first + k : BLOCK_PX] for k in range(4))
    return float(np.abs(a - d + 3 * (c - b)).mean())
