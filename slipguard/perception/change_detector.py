"""The change detector: an image that differs from the last measured one by less than noise need not be measured.

Every image is compared with one kept from the last change, so that slow creep accumulates until it is detected. The
difference is tested in units of the sensor's noise in three ways: the worst block; the mean square in and around the
contact; and the part of it that a small rotation or shift of this very image would cause, which detects far less than
a degree. Skipping begins only when the image has not changed for longer than the last change took: an object that
creeps on is measured in every frame.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from slipguard.perception.contact_gate import BLOCKS_HIGH, BLOCKS_WIDE, Blocks

AVERAGED = 8
"""The kept image is the mean of this many unchanged ones, which lowers its noise."""
QUIET_MIN_S, QUIET_MAX_S = 0.5, 4.0
"""Time without a change before a frame is skipped. Creep of 0.1 deg/s is detected within 2-4 s and is never skipped;
slower creep moves by less than 0.03 degrees between two measured frames."""
QUIET_SHARE = 2.0
"""Time without a change, as a multiple of the time that the last change took."""
GLITCH_FRAMES = 4
"""If the image returns to the previous one within this many frames, the change was a glitch and rest has not ended."""
WORST_STD = 6.0
"""Limit for the worst of 1200 blocks, three colors together: noise exceeds it once in 10,000 images."""
MEAN_STD = 5.0
MEAN_SHARE = 0.18
"""Limit for the mean square in and around the contact over that elsewhere: a share for the flicker of columns, which
is removed elsewhere but not here, and standard deviations of both means."""
MOTION_STD = 5.0
"""Limit for the rotation and shift found in the difference."""
SENSITIVE_DEG = 0.6
SENSITIVE_BLOCKS = 0.3
"""If a smaller rotation, or shift (a block is 8 pixels, 0.4 mm), would not be detected, every frame is measured: the
contact is faint."""
_LEVEL_PRIOR = 3.0
_OUTSIDE_MIN = 120
_NOISE_MAX = 2.5
"""Mean square of the difference away from the contact, over the sensor's noise; above it the image has changed."""
_ROUNDING_SQUARE = 0.25
"""A block mean between two gray levels flips by 0.5 around its middle, even with a very quiet sensor."""
_CHANNELS = 3


class _Region:
    """The blocks in and around a contact, and what follows from them alone. near: (1200,) bool; None: all blocks."""

    def __init__(self, near: NDArray[np.bool_] | None) -> None:
        self.source = near
        self.near = np.ones(BLOCKS_HIGH * BLOCKS_WIDE, np.float32) if near is None else near.astype(np.float32)
        self.inside = float(self.near.sum())
        self.outside = float(self.near.size) - self.inside
        self._away = 1.0 - self.near
        self._level_share = self._away / np.float32(self.outside + _LEVEL_PRIOR)
        away = self._away.reshape(BLOCKS_HIGH, BLOCKS_WIDE)
        self._column_share = (away / (away.sum(axis=0) + np.float32(_LEVEL_PRIOR)))[..., None]

    def without_columns(self, difference: Blocks) -> Blocks:
        """Remove the mean away from the contact (drift of the light), then that of each column: DIGIT columns flicker.

        Returns:
            (1200, 3) float32.
        """
        image = (difference - self._level_share @ difference).reshape(BLOCKS_HIGH, BLOCKS_WIDE, _CHANNELS)
        image -= (self._column_share * image).sum(axis=0)
        return np.asarray(image.reshape(-1, _CHANNELS), np.float32)

    @cached_property
    def squared_motions(self) -> NDArray[np.float64]:
        """How far a unit rotation and both unit shifts move the blocks near the contact, squares summed."""
        x, y = _places(self.near)
        weight = self.near.reshape(BLOCKS_HIGH, BLOCKS_WIDE)
        return np.array([float((weight * (x**2 + y**2)).sum()), self.inside, self.inside])


@dataclass(slots=True, eq=False)
class _KeptImage:
    """The image that others are compared with.

    blocks: (1200, 3) float32, mean of `count` images. region: the contact in it.
    since_s: when it was taken. change_s: how long the change before it took.
    motions: (3600, 3), change by a rotation (rad) and by shifts right and down (blocks); None until needed.
    strengths: (3,) norms of these.
    """

    blocks: Blocks
    region: _Region
    since_s: float
    change_s: float
    count: int = 1
    motions: NDArray[np.float32] | None = None
    strengths: NDArray[np.float64] | None = None


class ChangeDetector:
    """Keeps one finger's image since its last change.

    Args:
        inverse_std: (3,) one over the noise of a block mean, per channel.
        background: (1200, 3) block means of the background image, which do not move with the contact, or None.
    """

    def __init__(self, inverse_std: NDArray[np.float32], background: Blocks | None) -> None:
        self._inverse_std = inverse_std
        self._background = background
        self._noise_min = _ROUNDING_SQUARE * float(np.mean(inverse_std**2))
        self._kept: _KeptImage | None = None
        self._previous: _KeptImage | None = None
        self._glitch_frames_left = 0
        self.restored = False
        """Whether the last image equals the one before the last change: that change was a glitch, and estimates
        measured since then are not valid for it."""

    @property
    def since_s(self) -> float:
        """When the image last changed; infinity if no image is kept."""
        return math.inf if self._kept is None else self._kept.since_s

    def reset(self) -> None:
        """Forget the kept image: the next image counts as a change."""
        self._kept = self._previous = None

    def unchanged(self, blocks: Blocks) -> bool:
        """Return whether an image, (1200, 3) block means, differs from the kept one by no more than noise."""
        self.restored = self._previous is not None and self._equal(blocks, self._previous)
        if self.restored:
            self._kept, self._previous = self._previous, None
            return True
        return self._kept is not None and self._equal(blocks, self._kept)

    def _equal(self, blocks: Blocks, kept: _KeptImage) -> bool:
        region = kept.region
        difference = blocks - kept.blocks
        difference *= self._inverse_std * np.float32(1.0 / math.sqrt(1.0 + 1.0 / kept.count))
        # A step along a column contains neither drift nor flicker, and is at most twice the worst block.
        step = difference[BLOCKS_WIDE:] - difference[:-BLOCKS_WIDE]
        if float(np.einsum("ij,ij->i", step, step).max()) > 4.0 * WORST_STD**2 * _NOISE_MAX:
            return False
        difference = region.without_columns(difference)
        square = np.einsum("ij,ij->i", difference, difference)
        inside, outside = region.inside, region.outside
        within, total = float(region.near @ square), float(square.sum())
        noise, scatter2 = 1.0, 2.0 / (_CHANNELS * max(inside, 1.0))
        if outside >= _OUTSIDE_MIN:
            scatter2 += 2.0 / (_CHANNELS * outside)
            noise = (total - within) / (_CHANNELS * outside)
            if not noise < _NOISE_MAX:
                return False
            noise = max(noise, self._noise_min)
        if float(square.max()) > WORST_STD**2 * max(noise, 1.0):
            return False
        if within > _CHANNELS * inside * noise * (1.0 + MEAN_SHARE + MEAN_STD * math.sqrt(scatter2)):
            return False
        motions, strengths = self._motions(kept)
        found = difference.ravel() @ motions
        return bool((np.abs(found) <= MOTION_STD * math.sqrt(noise) * strengths).all())

    def sensitive(self, with_rotation: bool) -> bool:
        """Return whether a small shift, and a small rotation if `with_rotation`, would be detected."""
        if self._kept is None:
            return False
        strengths = self._motions(self._kept)[1]
        # The squared strength contains the noise of the gradient itself, which is no signal.
        own = 0.5 * _CHANNELS * self._kept.region.squared_motions / self._kept.count
        signal = np.sqrt(np.maximum(strengths**2 - own, 1e-9))
        least = MOTION_STD * math.sqrt(1.0 + 1.0 / self._kept.count) / signal
        if with_rotation and math.degrees(float(least[0])) > SENSITIVE_DEG:
            return False
        return bool((least[1:] <= SENSITIVE_BLOCKS).all())

    def add(self, blocks: Blocks, near: NDArray[np.bool_] | None, now_s: float, unchanged: bool) -> None:
        """Add a measured image: average it with the kept one if unchanged, else keep it instead.

        Args:
            blocks: (1200, 3) block means.
            near: (1200,) bool, the blocks in and around the contact; None without contact.
            now_s: Capture time of the image.
            unchanged: The result of `unchanged` for this image.
        """
        kept = self._kept
        self._glitch_frames_left -= 1
        if self._glitch_frames_left <= 0:
            self._previous = None
        if unchanged and kept is not None:
            if kept.count < AVERAGED:
                kept.blocks = kept.blocks + (blocks - kept.blocks) * np.float32(1.0 / (kept.count + 1))
                kept.count += 1
                kept.motions = None
            return
        region = kept.region if kept is not None and kept.region.source is near else _Region(near)
        change_s = 0.0 if kept is None else max(now_s - kept.since_s, 0.0)
        if kept is not None and kept.count >= AVERAGED:
            self._previous, self._glitch_frames_left = kept, GLITCH_FRAMES + 1
        self._kept = _KeptImage(blocks, region, now_s, change_s)

    def at_rest(self, now_s: float) -> bool:
        """Return whether the image has been unchanged for long enough to skip a frame."""
        kept = self._kept
        if kept is None or kept.count < AVERAGED:
            return False
        wait_s = min(max(QUIET_SHARE * kept.change_s, QUIET_MIN_S), QUIET_MAX_S)
        return now_s - kept.since_s >= wait_s

    def _motions(self, kept: _KeptImage) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
        if kept.motions is None or kept.strengths is None:
            imprint = kept.blocks if self._background is None else kept.blocks - self._background
            image = (imprint * self._inverse_std).reshape(BLOCKS_HIGH, BLOCKS_WIDE, _CHANNELS)
            slope_x, slope_y = np.zeros_like(image), np.zeros_like(image)
            slope_x[:, 1:-1] = 0.5 * (image[:, 2:] - image[:, :-2])
            slope_y[1:-1] = 0.5 * (image[2:] - image[:-2])
            x, y = _places(kept.region.near)
            near = kept.region.near.reshape(BLOCKS_HIGH, BLOCKS_WIDE)
            rotation = slope_x * (near * y)[..., None] - slope_y * (near * x)[..., None]
            slope_x *= near[..., None]
            slope_y *= near[..., None]
            kept.motions = np.stack([rotation.ravel(), slope_x.ravel(), slope_y.ravel()], axis=1).astype(np.float32)
            kept.strengths = np.sqrt(np.einsum("ij,ij->j", kept.motions, kept.motions).astype(np.float64)) + 1e-6
        return kept.motions, kept.strengths


def _places(near: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the blocks' distances right and down from the center of the contact, (40, 30) each."""
    y, x = np.mgrid[0:BLOCKS_HIGH, 0:BLOCKS_WIDE].astype(np.float32)
    weight = near.reshape(BLOCKS_HIGH, BLOCKS_WIDE)
    mass = max(float(weight.sum()), 1.0)
    return x - np.float32((weight * x).sum() / mass), y - np.float32((weight * y).sum() / mass)
