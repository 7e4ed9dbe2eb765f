"""Dead rows and columns of the sensor: found in the background image, interpolated in every frame.

On a dead line the difference from the background image is zero, under a contact too. That is a sharp pattern which
stays in place while the contact rotates and holds the texture registration back.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slipguard.perception.contact.gate import check_frame

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
Indices = NDArray[np.intp]


@dataclass(frozen=True, slots=True, eq=False)
class _Interpolation:
    """Lines along one axis: the dead ones, the nearest sound ones before and after, and the weight of the latter."""

    dead: Indices
    before: Indices
    after: Indices
    weight_after: NDArray[np.float32]


class DeadLines:
    """The dead lines of one unit; none if the background image is unknown. background: (320, 240, 3) uint8."""

    def __init__(self, background: Image | None) -> None:
        self._rows = self._columns = _interpolation(np.zeros(2, np.bool_))
        if background is not None:
            check_frame(background)
            self._rows = _interpolation(_find_dead(background))
            self._columns = _interpolation(_find_dead(background.transpose(1, 0, 2)))

    @property
    def rows(self) -> tuple[int, ...]:
        """Dead rows, from the top."""
        return tuple(int(row) for row in self._rows.dead)

    @property
    def columns(self) -> tuple[int, ...]:
        """Dead columns, from the left."""
        return tuple(int(column) for column in self._columns.dead)

    def interpolate(self, image: Image) -> Image:
        """Return the image with its dead lines interpolated; the same array if the unit has none.

        Raises:
            FrameCorrupt: There are lines to interpolate, and the array is no gel image.
        """
        if not (self._rows.dead.size or self._columns.dead.size):
            return image
        check_frame(image)
        repaired = image.copy()
        _fill(repaired, self._rows)
        _fill(repaired.transpose(1, 0, 2), self._columns)
        return repaired


def _find_dead(lines: Image) -> NDArray[np.bool_]:
    """Return which of n lines, (n, m, 3) uint8, differ from those on both sides: (n,) bool."""
    levels = lines.astype(np.int16)
    apart = np.zeros(len(levels))
    for away in NEIGHBORS_PX:
        steps = np.median(np.abs(levels[away:] - levels[:-away]).sum(axis=2), axis=1)
        edge = np.full(away, np.inf)
        apart = np.maximum(apart, np.minimum(np.append(edge, steps), np.append(steps, edge)))
    dead = apart > max(DEAD_LEVELS, DEAD_TIMES * float(np.median(apart)))
    return dead if np.count_nonzero(dead) <= DEAD_SHARE_MAX * len(dead) else np.zeros_like(dead)


def _interpolation(is_dead: NDArray[np.bool_]) -> _Interpolation:
    dead, sound = np.flatnonzero(is_dead), np.flatnonzero(~is_dead)
    place = np.searchsorted(sound, dead)
    before = sound[np.maximum(place - 1, 0)]
    after = sound[np.minimum(place, len(sound) - 1)]
    before, after = np.where(place > 0, before, after), np.where(place < len(sound), after, before)
    weight = (dead - before) / np.maximum(after - before, 1)
    return _Interpolation(dead, before, after, weight.astype(np.float32)[:, None, None])


def _fill(lines: Image, fill: _Interpolation) -> None:
    """Overwrite the dead lines of (n, m, 3)."""
    if fill.dead.size:
        before = lines[fill.before].astype(np.float32)
        lines[fill.dead] = np.rint(before + fill.weight_after * (lines[fill.after] - before)).astype(np.uint8)
