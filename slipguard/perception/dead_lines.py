"""Dead rows and columns of the sensor: found in the background image, interpolated in every frame.

On a dead line the difference from the background image is zero, under a contact too. That is a sharp pattern which
stays in place while the contact rotates and holds the texture registration back.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from slipguard.perception.contact_gate import check_frame

DEAD_LEVELS = 16.0
"""A dead line differs by this much (gray levels, its colors together, median along it) from the lines on both sides.
Lines of 160 images of real gels differ by 11 at most, and a line stuck at the gel's own gray by 20 and more on most
units: it has no color."""
DEAD_TIMES = 2.5
"""A dead line also differs by this multiple of the median of all lines: an image of noise has no dead lines."""
NEIGHBORS_PX = (1, 2)
"""Two adjacent dead lines may be equal, so lines are also compared with the next but one. A sound line between a dead
one and the border counts as dead too."""
DEAD_SHARE_MAX = 0.25
"""With more dead lines than this the image is no image of the gel; it is left unchanged."""

Image = NDArray[np.uint8]


class DeadLines:
    """The dead lines of one unit; none if the background image is unknown. background: (320, 240, 3) uint8."""

    def __init__(self, background: Image | None) -> None:
        self.rows: list[int] = []
        """Dead rows, from the top."""
        self.columns: list[int] = []
        """Dead columns, from the left."""
        if background is not None:
            check_frame(background)
            self.rows = _find_dead(background)
            self.columns = _find_dead(background.transpose(1, 0, 2))

    def interpolate(self, image: Image) -> Image:
        """Return the image with its dead lines interpolated; the same array if the unit has none.

        Raises:
            FrameCorrupt: There are lines to interpolate, and the array is no gel image.
        """
        if not (self.rows or self.columns):
            return image
        check_frame(image)
        repaired = image.copy()
        _fill(repaired, self.rows)
        _fill(repaired.transpose(1, 0, 2), self.columns)
        return repaired


def _find_dead(lines: Image) -> list[int]:
    """Return which of n lines, (n, m, 3) uint8, differ from those on both sides."""
    levels = lines.astype(np.int16)
    apart = np.zeros(len(levels))
    for away in NEIGHBORS_PX:
        steps = np.median(np.abs(levels[away:] - levels[:-away]).sum(axis=2), axis=1)
        edge = np.full(away, np.inf)
        apart = np.maximum(apart, np.minimum(np.append(edge, steps), np.append(steps, edge)))
    dead = np.flatnonzero(apart > max(DEAD_LEVELS, DEAD_TIMES * float(np.median(apart))))
    return dead.tolist() if len(dead) <= DEAD_SHARE_MAX * len(apart) else []


def _fill(lines: Image, dead: list[int]) -> None:
    """Overwrite the dead lines of (n, m, 3) from the nearest sound ones on both sides."""
    sound = np.setdiff1d(np.arange(len(lines)), dead)
    for line in dead:
        place = int(np.searchsorted(sound, line))
        before, after = sound[max(place - 1, 0)], sound[min(place, len(sound) - 1)]
        weight = min(max((line - before) / max(after - before, 1), 0.0), 1.0)
        lines[line] = np.rint((1.0 - weight) * lines[before] + weight * lines[after]).astype(np.uint8)
