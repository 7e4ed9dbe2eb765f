"""Rows and columns of the sensor that are stuck: found in the no-contact image, filled from their neighbours in others.

Where a line is stuck the difference from the no-contact image is nothing, under a contact too: a pattern that stays
while the contact turns, sharp enough to hold the relief's fit where it is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slipguard.perception.contact.gate import check_frame

STUCK_LEVELS = 16.0
"""A stuck line is this far (grey levels, its colours together, median along it) from the lines on both its sides.
Lines of 160 pictures of real gels come to 11 at most, and a line stuck at the gel's own grey to 20 and more on most
units: it has no colour."""
STUCK_TIMES = 2.5
"""... and this many times as far as the middle one of all lines: a picture of noise has no stuck lines."""
NEIGHBOURS_PX = (1, 2)
"""Two stuck lines side by side may be alike: they are told from the next but one. A sound line between a stuck one and
the border counts as stuck too."""
STUCK_SHARE = 0.25
"""What would be left of a picture with more stuck lines than this is no picture of the gel; it is left as it is."""

Image = NDArray[np.uint8]
Places = NDArray[np.intp]


@dataclass(frozen=True, slots=True, eq=False)
class _Fill:
    """Lines along one axis: which are stuck, the nearest sound ones before and after, and the share of the latter."""

    stuck: Places
    before: Places
    after: Places
    share: NDArray[np.float32]


class DeadLines:
    """The stuck lines of one unit; none where the no-contact image is not known. background: (320, 240, 3) uint8."""

    def __init__(self, background: Image | None) -> None:
        self._rows = self._columns = _fill_of(np.zeros(2, np.bool_))
        if background is not None:
            check_frame(background)
            self._rows = _fill_of(_stuck(background))
            self._columns = _fill_of(_stuck(background.transpose(1, 0, 2)))

    @property
    def rows(self) -> tuple[int, ...]:
        """Stuck rows, from the top."""
        return tuple(int(row) for row in self._rows.stuck)

    @property
    def columns(self) -> tuple[int, ...]:
        """Stuck columns, from the left."""
        return tuple(int(column) for column in self._columns.stuck)

    def filled(self, image: Image) -> Image:
        """The picture with its stuck lines drawn from the sound ones beside them; the same one where none is stuck.

        Raises `FrameCorrupt` for what is no gel picture where it has lines to fill.
        """
        if not (self._rows.stuck.size or self._columns.stuck.size):
            return image
        check_frame(image)
        whole = image.copy()
        _draw(whole, self._rows)
        _draw(whole.transpose(1, 0, 2), self._columns)
        return whole


def _stuck(lines: Image) -> NDArray[np.bool_]:
    """(n, m, 3) uint8 to (n,): which of the n lines are unlike those on both sides."""
    levels = lines.astype(np.int16)
    apart = np.zeros(len(levels))
    for away in NEIGHBOURS_PX:
        steps = np.median(np.abs(levels[away:] - levels[:-away]).sum(axis=2), axis=1)
        edge = np.full(away, np.inf)
        apart = np.maximum(apart, np.minimum(np.append(edge, steps), np.append(steps, edge)))
    stuck = apart > max(STUCK_LEVELS, STUCK_TIMES * float(np.median(apart)))
    return stuck if np.count_nonzero(stuck) <= STUCK_SHARE * len(stuck) else np.zeros_like(stuck)


def _fill_of(stuck: NDArray[np.bool_]) -> _Fill:
    dead, sound = np.flatnonzero(stuck), np.flatnonzero(~stuck)
    place = np.searchsorted(sound, dead)
    before = sound[np.maximum(place - 1, 0)]
    after = sound[np.minimum(place, len(sound) - 1)]
    before, after = np.where(place > 0, before, after), np.where(place < len(sound), after, before)
    share = (dead - before) / np.maximum(after - before, 1)
    return _Fill(dead, before, after, share.astype(np.float32)[:, None, None])


def _draw(lines: Image, fill: _Fill) -> None:
    """Draw the stuck lines of (n, m, 3) from the sound ones."""
    if fill.stuck.size:
        before = lines[fill.before].astype(np.float32)
        lines[fill.stuck] = np.rint(before + fill.share * (lines[fill.after] - before)).astype(np.uint8)
