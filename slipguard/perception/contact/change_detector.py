"""Whether a gel picture still shows what it showed: below the sensor's noise it does, and another look can wait.

Every picture is compared with one kept from when it last changed, so that a creep adds up until it is seen. Four
things are asked of the difference, in units of the sensor's noise: the worst block, the whole of it in and around the
contact, and how much of it is what a small turn or shift of this very picture would make, which sees far less than a
degree. Skipping begins when nothing has changed for longer than the last change took to come: what creeps on is
measured throughout.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slipguard.perception.contact.gate import BLOCKS_HIGH, BLOCKS_WIDE, Blocks

AVERAGED = 8
"""The kept picture is the mean of so many unchanged ones: less noise to compare with."""
QUIET_MIN_S, QUIET_MAX_S = 0.5, 4.0
"""Nothing must have changed for so long before a look is left out. A creep of 0.1 degrees a second, which takes 2-4 s
to be seen, is never skipped; slower ones move by less than 0.03 degrees between two looks."""
GLITCH_FRAMES = 4
"""A picture that looks as before within so many frames was a glitch or a tremor: the rest has not ended."""
QUIET_SHARE = 2.0
"""... and for so many times as long as the last change took."""
WORST_STD = 6.0
"""Difference of the worst of 1200 blocks, three colours together: by noise alone once in 10,000 pictures."""
WHOLE_STD = 5.0
WHOLE_SHARE = 0.18
"""Excess of the mean square in and around the contact over that away from it: a share that is the columns', taken out
there and not here, and standard deviations of both means."""
MOVED_STD = 5.0
"""Turn or shift found in the difference."""
TELLING_DEG = 0.6
TELLING_BLOCKS = 0.3
"""Where a turn or a shift (a block is 8 pixels, 0.4 mm) must be larger than this to be noticed, every frame is
measured: the contact is faint."""
_LEVEL_PRIOR = 3.0
_OUTSIDE_MIN = 120
_NOISE_MAX = 2.5
"""Mean square of the noise away from the contact over what is known of the sensor; beyond it the picture is another
one."""
_ROUNDING_SQUARE = 0.25
"""A block's mean that lies between two grey levels flips by 0.5 about its middle, however quiet the sensor."""
_CHANNELS = 3


@dataclass(slots=True, eq=False)
class _Kept:
    """What pictures are compared with. blocks: mean of `count` pictures. near: (1200,) float32, 1 in and around the
    contact. moves: (3600, 3) what a turn (rad) and shifts right and down (blocks) would change, None until needed.
    """

    blocks: Blocks
    near: NDArray[np.float32]
    since_s: float
    took_s: float
    count: int = 1
    moves: NDArray[np.float32] | None = None
    strengths: NDArray[np.float64] | None = None


class ChangeDetector:
    """Remembers one finger's picture since it last changed.

    per_std: (3,) one over the noise of a block's mean, per channel. background: (1200, 3) no-contact block means, which
    do not move with the contact, or None.
    """

    def __init__(self, per_std: NDArray[np.float32], background: Blocks | None) -> None:
        self._per_std = per_std
        self._background = background
        self._noise_min = _ROUNDING_SQUARE * float(np.mean(per_std**2))
        self._kept: _Kept | None = None
        self._before: _Kept | None = None
        self._doubtful = 0
        self.restored = False
        """Whether the last picture looks as before the last change, which was a glitch: what was measured since is not
        of it."""

    def forget(self) -> None:
        """Nothing is known: the next picture is a change."""
        self._kept = self._before = None

    def unchanged(self, blocks: Blocks) -> bool:
        """Whether a picture, (1200, 3) block means, differs from the kept one by no more than noise."""
        self.restored = self._before is not None and self._alike(blocks, self._before)
        if self.restored:
            self._kept, self._before = self._before, None
            return True
        return self._kept is not None and self._alike(blocks, self._kept)

    def _alike(self, blocks: Blocks, kept: _Kept) -> bool:
        difference = self._without_columns(blocks - kept.blocks, kept.near)
        difference *= self._per_std * np.float32(1.0 / math.sqrt(1.0 + 1.0 / kept.count))
        square = np.einsum("ij,ij->i", difference, difference)
        inside, all_blocks = float(kept.near.sum()), float(square.size)
        within, total = float(kept.near @ square), float(square.sum())
        outside = all_blocks - inside
        noise, scatter2 = 1.0, 2.0 / (_CHANNELS * max(inside, 1.0))
        if outside >= _OUTSIDE_MIN:
            scatter2 += 2.0 / (_CHANNELS * outside)
            noise = (total - within) / (_CHANNELS * outside)
            if not noise < _NOISE_MAX:
                return False
            noise = max(noise, self._noise_min)
        if float(square.max()) > WORST_STD**2 * max(noise, 1.0):
            return False
        if within > _CHANNELS * inside * noise * (1.0 + WHOLE_SHARE + WHOLE_STD * math.sqrt(scatter2)):
            return False
        moves, strengths = self._moves(kept)
        found = difference.ravel() @ moves
        return bool((np.abs(found) <= MOVED_STD * math.sqrt(noise) * strengths).all())

    def telling(self, with_rotation: bool) -> bool:
        """Whether a small turn (where there is one to tell) and a small shift would not go unnoticed."""
        if self._kept is None:
            return False
        strengths = self._moves(self._kept)[1]
        # Of the squared strength the gradient's own noise is no signal.
        own = 0.5 * _CHANNELS * self._lever2(self._kept) / self._kept.count
        signal = np.sqrt(np.maximum(strengths**2 - own, 1e-9))
        least = MOVED_STD * math.sqrt(1.0 + 1.0 / self._kept.count) / signal
        if with_rotation and math.degrees(float(least[0])) > TELLING_DEG:
            return False
        return bool((least[1:] <= TELLING_BLOCKS).all())

    def note(self, blocks: Blocks, near: NDArray[np.bool_] | None, now_s: float, unchanged: bool) -> None:
        """A picture was measured. near: (1200,) bool, blocks in and around its contact; None: there is none."""
        kept = self._kept
        self._doubtful -= 1
        if self._doubtful <= 0:
            self._before = None
        if unchanged and kept is not None:
            if kept.count < AVERAGED:
                kept.blocks = kept.blocks + (blocks - kept.blocks) * np.float32(1.0 / (kept.count + 1))
                kept.count += 1
                kept.moves = None
            return
        inside = np.ones(len(blocks), np.float32) if near is None else near.astype(np.float32)
        took_s = 0.0 if kept is None else max(now_s - kept.since_s, 0.0)
        if kept is not None and kept.count >= AVERAGED:
            self._before, self._doubtful = kept, GLITCH_FRAMES + 1
        self._kept = _Kept(blocks, inside, now_s, took_s)

    def at_rest(self, now_s: float) -> bool:
        """Whether nothing has changed for so long that a look may be left out."""
        kept = self._kept
        if kept is None or kept.count < AVERAGED:
            return False
        wait_s = min(max(QUIET_SHARE * kept.took_s, QUIET_MIN_S), QUIET_MAX_S)
        return now_s - kept.since_s >= wait_s

    def _without_columns(self, difference: Blocks, near: NDArray[np.float32]) -> Blocks:
        """Take out what the picture shares away from the contact, as light drifts, then what whole columns share: DIGIT
        columns flicker together.
        """
        away = 1.0 - near
        level = (away @ difference) / (float(away.sum()) + _LEVEL_PRIOR)
        picture = (difference - level).reshape(BLOCKS_HIGH, BLOCKS_WIDE, _CHANNELS)
        away = away.reshape(BLOCKS_HIGH, BLOCKS_WIDE)
        columns = np.einsum("rc,rck->ck", away, picture) / (away.sum(axis=0) + np.float32(_LEVEL_PRIOR))[:, None]
        return np.asarray((picture - columns).reshape(-1, _CHANNELS), np.float32)

    def _moves(self, kept: _Kept) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
        if kept.moves is None or kept.strengths is None:
            imprint = kept.blocks if self._background is None else kept.blocks - self._background
            picture = (imprint * self._per_std).reshape(BLOCKS_HIGH, BLOCKS_WIDE, _CHANNELS)
            slope_x, slope_y = np.zeros_like(picture), np.zeros_like(picture)
            slope_x[:, 1:-1] = 0.5 * (picture[:, 2:] - picture[:, :-2])
            slope_y[1:-1] = 0.5 * (picture[2:] - picture[:-2])
            x, y = _places(kept.near)
            near = kept.near.reshape(BLOCKS_HIGH, BLOCKS_WIDE)
            rotation = slope_x * (near * y)[..., None] - slope_y * (near * x)[..., None]
            slope_x *= near[..., None]
            slope_y *= near[..., None]
            kept.moves = np.stack([rotation.ravel(), slope_x.ravel(), slope_y.ravel()], axis=1).astype(np.float32)
            kept.strengths = np.sqrt(np.einsum("ij,ij->j", kept.moves, kept.moves).astype(np.float64)) + 1e-6
        return kept.moves, kept.strengths

    def _lever2(self, kept: _Kept) -> NDArray[np.float64]:
        """Sum of squared levers of a turn and of the shifts over the blocks near the contact."""
        x, y = _places(kept.near)
        near = kept.near.reshape(BLOCKS_HIGH, BLOCKS_WIDE)
        count = float(near.sum())
        return np.array([float((near * (x**2 + y**2)).sum()), count, count])


def _places(near: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Blocks right and down of the middle of the contact, (40, 30) each."""
    y, x = np.mgrid[0:BLOCKS_HIGH, 0:BLOCKS_WIDE].astype(np.float32)
    weight = near.reshape(BLOCKS_HIGH, BLOCKS_WIDE)
    mass = max(float(weight.sum()), 1.0)
    return x - np.float32((weight * x).sum() / mass), y - np.float32((weight * y).sum() / mass)
