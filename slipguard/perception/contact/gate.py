"""Which frames need no network, for there is no contact, and which show no gel of this unit, or not sharply.

That is asked of a picture of 30 x 40 block means (8 x 8 pixels each), where the camera's noise is small
and known. A wrong "maybe contact" costs two milliseconds, a wrong "no contact" costs the object: the gate leans to
the first.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.devices import FRAME_HEIGHT_PX, FRAME_WIDTH_PX
from slipguard.errors import FrameCorrupt

BLOCKS_WIDE, BLOCKS_HIGH = FRAME_WIDTH_PX // 8, FRAME_HEIGHT_PX // 8
DEFAULT_NOISE_BGR = (2.9, 1.5, 2.4)
"""Noise of one pixel, grey levels, one standard deviation: measured on two DIGIT units."""
_BLOCK_NOISE_SHARE = 0.37
"""Noise of an 8 x 8 mean over noise of a pixel, at the sensor's lag-1 pixel correlation of 0.65 (white: 0.125)."""
_ROUNDING_STD = 0.3
"""Rounding to whole grey levels in three halvings, grey levels."""
_DARK, _BRIGHT = 4, 251
"""A frame with no block above, or none below, carries no picture."""
_UNLIKE_LEVELS = 8.0
"""Away from the contact a frame differs from the no-contact image, but for an even change of light, by 1-3 grey levels
on average, by 4.3 in the worst of real lighting drifts; swapped colours and a failing lamp give 9 and more."""
_OUTSIDE_MIN = 120
"""Fewer blocks than this outside the contact (a tenth of the frame) show neither its outline nor the light."""

_BRIGHTER_LEVELS = 30.0
"""Even change of a colour's light, grey levels; real drifts and rendered ones reach 6. The network was taught no more
than a few times that."""
_NOISY_LEVELS = 4.0
"""Mean difference from block to block away from the contact, grey levels: 1-2.3 in real frames, 4.6 where a pixel's
noise is 32."""
_SWAPPED_MARGIN = 0.08
"""In another order of the colours the three correlations with the no-contact image add up to more than in the right
one by 0.1 and more where the colours are swapped (99 % of rendered frames), and to less by 0.04 at least where not."""
_ORDERS = np.array([[3 * k + c for k, c in enumerate(order)] for order in itertools.permutations(range(3))])
"""The six orders of three channels, as places in a 3 x 3 table; the right one first."""
_ALL = np.ones(BLOCKS_WIDE * BLOCKS_HIGH, np.float32)
_BLIND_SHARE = 0.02
"""A contact with more of its blocks all black or all white lies under a glare or a dead spot that hides its outline.
Where the no-contact image has more pixels at the end of a colour's range a contact shows edges that stay while it
turns; nine real units have none."""

_FINE_SHARE = 0.7
"""A picture with less of its no-contact image's unevenness (from block to block, beside the contact) is out of focus:
what the gel itself shows, which stays where it is, then outweighs a faint contact. 0.87 and more in real frames, 1.02
and more in rendered ones of many units; 0.3-0.5, on gels that show little up to 0.75, under a blur of 9 pixels."""
_FINE_MIN = 60
"""Fewer blocks than this beside the contact do not tell it."""

_NEIGHBOURS = np.ones((3, 3), np.uint8)

Blocks = NDArray[np.float32]


def check_frame(image: NDArray[np.uint8]) -> None:
    """Raise `FrameCorrupt` unless image is a (320, 240, 3) uint8 picture that is neither all black nor all white."""
    if not isinstance(image, np.ndarray) or image.dtype != np.uint8 or image.ndim != 3:
        seen = f"{image.dtype} {image.shape}" if isinstance(image, np.ndarray) else type(image).__name__
        raise FrameCorrupt(f"frame is {seen}, expected uint8 (320, 240, 3) BGR; it is left out")
    if image.shape != (FRAME_HEIGHT_PX, FRAME_WIDTH_PX, 3):
        height, width = image.shape[:2]
        raise FrameCorrupt(
            f"frame is {width}×{height} with {image.shape[2]} channels, expected {FRAME_WIDTH_PX}×{FRAME_HEIGHT_PX}"
            " BGR; check the stream format of the camera"
        )


def block_means(image: NDArray[np.uint8]) -> Blocks:
    """Means of 8 x 8 pixels: (320, 240, 3) uint8 to (1200, 3) float32, row by row.

    Raises `FrameCorrupt` on anything that is no gel picture, all-black and all-white frames included.
    """
    check_frame(image)
    small: NDArray[Any] = image
    for _ in range(3):  # halving three times is faster than dividing by eight once
        half = (small.shape[1] // 2, small.shape[0] // 2)
        small = cv2.resize(small, half, interpolation=cv2.INTER_AREA)
    if small.max() < _DARK:
        raise FrameCorrupt("frame is all black; check the light and the lens cap of the sensor")
    if small.min() > _BRIGHT:
        raise FrameCorrupt("frame is all white; check the exposure and the LEDs of the sensor")
    return small.reshape(-1, 3).astype(np.float32)


class ContactGate:
    """Knows one unit's no-contact picture and noise. Holds no other state.

    background: (320, 240, 3) uint8 or None; without one every frame may be contact.
    noise_bgr: standard deviation of one pixel per channel, grey levels; None: what is typical of a DIGIT.
    """

    def __init__(
        self,
        background: NDArray[np.uint8] | None,
        noise_bgr: Sequence[float] | NDArray[np.floating] | None = None,
        gate_sigma: float = 7.0,
    ) -> None:
        self.noise_known = noise_bgr is not None
        """Whether the noise is this unit's own: a quieter one than is typical would hide a turn of some degrees."""
        given = np.asarray(DEFAULT_NOISE_BGR if noise_bgr is None else noise_bgr, np.float32)
        noise = given.reshape(-1, 3).mean(axis=0)
        noise = np.where(np.isfinite(noise), np.clip(noise, 0.3, 20.0), DEFAULT_NOISE_BGR)
        self.noise_bgr: NDArray[np.float32] = noise.astype(np.float32)
        """(3,) standard deviation of a pixel."""
        self.per_std: NDArray[np.float32] = (
            1.0 / np.sqrt((_BLOCK_NOISE_SHARE * noise) ** 2 + _ROUNDING_STD**2)
        ).astype(np.float32)
        """(3,) one over the noise of a block's mean."""
        self._limit = gate_sigma**2
        self.background: Blocks | None = None if background is None else block_means(background)
        """Block means of the no-contact picture."""
        self._clipped = None if background is None else _clipped_share(background)
        if self.background is not None:
            self._fine = _unevenness(self.background)
        x, y = np.meshgrid(np.linspace(-1, 1, BLOCKS_WIDE), np.linspace(-1, 1, BLOCKS_HIGH))
        drift = np.stack([np.ones(x.size), x.ravel(), y.ravel()], axis=1)
        self._drift: NDArray[np.float32] = np.linalg.qr(drift)[0].astype(np.float32)

    def may_be_contact(self, blocks: Blocks) -> bool:
        """False only where nothing but noise and a drift of the light sets the picture apart from no contact.

        The drift taken out is a level and a slope per channel.
        """
        if self.background is None:
            return True
        difference = blocks - self.background
        difference -= self._drift @ (self._drift.T @ difference)
        difference *= self.per_std
        return bool(np.einsum("ij,ij->i", difference, difference).max() > self._limit)

    def unlike_levels(self, blocks: Blocks, near_patch: NDArray[np.bool_]) -> float:
        """How far a picture is from this unit's gel beside the contact, grey levels; infinite where it is none of it.

        The mean difference from the no-contact image but for an even change of light, 1-3 in good light.

        near_patch: (1200,) bool, the blocks in and around the contact, which must be neither black nor white. Without
        a no-contact image neither the light nor the order of the colours can be told.
        """
        outside = (~near_patch).astype(np.float32)
        count = float(outside.sum())
        if count < _OUTSIDE_MIN:
            return math.inf
        if blocks.max() > _BRIGHT or blocks.min() < _DARK:
            seen = blocks[near_patch]
            blind = (seen > _BRIGHT).all(axis=1) | (seen < _DARK).all(axis=1)
            if np.count_nonzero(blind) > _BLIND_SHARE * len(seen):
                return math.inf
        if self.background is None:
            return 0.0
        if self._clipped is not None and self._clipped[near_patch].mean(axis=0).max() > _BLIND_SHARE:
            return math.inf
        difference = blocks - self.background
        brighter = (outside @ difference) / count
        if np.abs(brighter).max() > _BRIGHTER_LEVELS:
            return math.inf
        unlike = float((outside @ np.abs(difference - brighter)).sum()) / (3.0 * count)
        if unlike > _UNLIKE_LEVELS:
            return math.inf
        beside = outside[1:] * outside[:-1]
        steps = np.abs(difference[1:] - difference[:-1])
        if float((beside @ steps).sum()) >= 3.0 * _NOISY_LEVELS * float(beside.sum()):
            return math.inf
        return math.inf if self._colours_swapped(blocks, self.background, outside / count) else unlike

    def out_of_focus(self, blocks: Blocks, near_patch: NDArray[np.bool_]) -> bool:
        """Whether a picture shows far less of this unit's gel beside the contact than the no-contact image does.

        Less light shows less of it too, which is allowed for. near_patch: (1200,) bool, the blocks in and around the
        contact. False where too little is seen beside it, and without a no-contact image.
        """
        if self.background is None:
            return False
        away = ~near_patch
        beside = (away[: -2 * BLOCKS_WIDE] & away[BLOCKS_WIDE:-BLOCKS_WIDE] & away[2 * BLOCKS_WIDE :]).astype(
            np.float32
        )
        if float(beside.sum()) < _FINE_MIN:
            return False
        middle = slice(BLOCKS_WIDE, -BLOCKS_WIDE)
        light = float((beside @ blocks[middle]).sum()) / max(float((beside @ self.background[middle]).sum()), 1.0)
        now, before = float((beside @ _unevenness(blocks)).sum()), float((beside @ self._fine).sum())
        return now < _FINE_SHARE * min(light, 1.0) * before

    @staticmethod
    def _colours_swapped(blocks: Blocks, background: Blocks, weights: NDArray[np.float32]) -> bool:
        """Whether the channels follow those of the no-contact image better in another order.

        weights: (1200,), nothing in the contact, whose own colours follow no order; their sum is one.
        """
        here, there = blocks - weights @ blocks, background - weights @ background
        weighed = here * weights[:, np.newaxis]
        deviations = np.sqrt(np.outer(weights @ np.square(there), (weighed * here).sum(axis=0)) + np.float32(1e-3))
        orders = ((there.T @ weighed) / deviations).take(_ORDERS).sum(axis=1)
        return bool(orders[1:].max() > orders[0] + _SWAPPED_MARGIN)


def _clipped_share(image: NDArray[np.uint8]) -> Blocks | None:
    """(1200, 3): the share of each block's pixels that are as dark or as bright as can be; None where no pixel is."""
    clipped = (image == 0) | (image == 255)
    if not clipped.any():
        return None
    shares = clipped.reshape(BLOCKS_HIGH, 8, BLOCKS_WIDE, 8, 3).mean(axis=(1, 3), dtype=np.float32)
    return np.asarray(shares.reshape(-1, 3), np.float32)


def _unevenness(blocks: Blocks) -> Blocks:
    """How far each block but those of the first and last row is from the mean of those above and below, doubled.

    Neither an even slope of the light nor columns that flicker show in it. (1140, 3) float32, grey levels.
    """
    middle = blocks[BLOCKS_WIDE:-BLOCKS_WIDE]
    return np.asarray(np.abs(blocks[2 * BLOCKS_WIDE :] - middle - middle + blocks[: -2 * BLOCKS_WIDE]), np.float32)


def near_patch(mask: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Blocks in and next to a mask, any resolution: (h, w) uint8 0/1 to (1200,) bool."""
    small = cv2.resize(mask * np.uint8(255), (BLOCKS_WIDE, BLOCKS_HIGH), interpolation=cv2.INTER_AREA)
    return cv2.dilate(small, _NEIGHBOURS).ravel() > 0
