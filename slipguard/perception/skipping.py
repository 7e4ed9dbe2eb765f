"""Which frames need not be measured: those without contact, unchanged ones, and those of the second finger.

Everything is decided on 30 x 40 block means (8 x 8 pixels each), in which the camera's noise is small and known. A
frame measured for nothing costs two milliseconds, a missed contact the object: doubtful frames are measured.

One object rotates in both images at once. If the finger with the smaller sigma has just found its image unchanged,
the other finger's last estimate is repeated. It is renewed every `refresh_s`, and with the next frame after any change
in the first finger's image. If the two fingers report different rotations, one is wrong: then both are measured.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.devices import FRAME_HEIGHT_PX, FRAME_WIDTH_PX
from slipguard.errors import FrameCorrupt
from slipguard.perception.estimate import Estimate

BLOCKS_WIDE, BLOCKS_HIGH = FRAME_WIDTH_PX // 8, FRAME_HEIGHT_PX // 8
DEFAULT_NOISE_BGR = (2.9, 1.5, 2.4)
"""Noise of one pixel, gray levels, one standard deviation: measured on two DIGIT units."""
BLACK_LEVEL, WHITE_LEVEL = 4, 251
"""A block mean below or above is black or white: there is no image in it."""
_BLOCK_NOISE_SHARE = 0.37
"""Noise of an 8 x 8 mean over noise of a pixel, at the sensor's lag-1 pixel correlation of 0.65 (white: 0.125)."""
_ROUNDING_STD = 0.3
"""Rounding to whole gray levels in three halvings, gray levels."""
_NEIGHBORS = np.ones((3, 3), np.uint8)
AVERAGED = 8
"""The kept image is the mean of this many unchanged ones, which lowers its noise."""
QUIET_S = 0.5
"""Time without a change before a frame is skipped."""
WORST_STD = 6.0
"""Limit for the worst of 1200 blocks, three colors together: noise exceeds it once in 10,000 images."""
MOTION_STD = 5.0
"""Limit for the rotation and shift found in the difference."""
SENSITIVE_DEG, SENSITIVE_BLOCKS = 0.6, 0.3
"""If a smaller rotation, or shift (a block is 8 pixels, 0.4 mm), would not be detected, every frame is measured: the
contact is faint."""
COLUMN_PRIOR = 3.0
"""Blocks away from the contact that a column needs for half of its mean to count."""
UNCHANGED = "unchanged"
OTHER_FINGER = "other finger"
MAX_FRAME_GAP_S = 0.05
"""Largest time between the frames of the two fingers: three frames at 60 Hz."""
DISAGREE_SIGMAS, DISAGREE_DEG = 3.0, 1.0
"""Two fingers disagree if their rotations differ by more than both: combined standard deviations, degrees."""

Blocks = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Skips:
    """Which stages may be skipped; switched off only to measure what each saves.

    no_contact: the network, without contact. unchanged: everything, on an unchanged image.
    whole: the network, while the texture shows that the contact moves as a whole.
    """

    no_contact: bool = True
    unchanged: bool = True
    whole: bool = True


ALL_SKIPS = Skips()


def check_frame(image: NDArray[np.uint8]) -> None:
    """Raise `FrameCorrupt` unless image is a (320, 240, 3) uint8 array."""
    if not isinstance(image, np.ndarray) or image.dtype != np.uint8 or image.ndim != 3:
        found = f"{image.dtype} {image.shape}" if isinstance(image, np.ndarray) else type(image).__name__
        raise FrameCorrupt(f"frame is {found}, expected uint8 (320, 240, 3) BGR; the frame is skipped")
    if image.shape != (FRAME_HEIGHT_PX, FRAME_WIDTH_PX, 3):
        height, width = image.shape[:2]
        raise FrameCorrupt(
            f"frame is {width}×{height} with {image.shape[2]} channels, expected {FRAME_WIDTH_PX}×{FRAME_HEIGHT_PX}"
            " BGR; check the stream format of the camera"
        )


def block_means(image: NDArray[np.uint8]) -> Blocks:
    """Return the means of 8 x 8 pixels: (320, 240, 3) uint8 to (1200, 3) float32, row by row.

    Raises:
        FrameCorrupt: The array is no gel image.
    """
    check_frame(image)
    small: NDArray[Any] = image
    for _ in range(3):  # halving three times is faster than dividing by eight once
        half = (small.shape[1] // 2, small.shape[0] // 2)
        small = cv2.resize(small, half, interpolation=cv2.INTER_AREA)
    return small.reshape(-1, 3).astype(np.float32)


def blocks_near(mask: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Return which blocks lie in or next to a mask: (h, w) uint8 0/1 of any resolution to (1200,) bool."""
    small = cv2.resize(mask * np.uint8(255), (BLOCKS_WIDE, BLOCKS_HIGH), interpolation=cv2.INTER_AREA)
    return cv2.dilate(small, _NEIGHBORS).ravel() > 0


class ContactGate:
    """Compares frames with one unit's background image and noise. Holds no other state.

    Args:
        background: (320, 240, 3) uint8 BGR, or None: then every frame may be contact.
        noise_bgr: Standard deviation of one pixel per channel, gray levels; None: typical values of a DIGIT.
        gate_noise_factor: Difference of a block, in standard deviations of its noise, above which it may be contact.

    Raises:
        FrameCorrupt: The background is no gel image, or it is all black or all white.
    """

    def __init__(
        self,
        background: NDArray[np.uint8] | None,
        noise_bgr: Sequence[float] | NDArray[np.floating] | None = None,
        gate_noise_factor: float = 7.0,
    ) -> None:
        self.noise_known = noise_bgr is not None
        """Whether the noise was measured on this unit: a typical value could hide a rotation of some degrees."""
        given = np.asarray(DEFAULT_NOISE_BGR if noise_bgr is None else noise_bgr, np.float32)
        noise = given.reshape(-1, 3).mean(axis=0)
        noise = np.where(np.isfinite(noise), np.clip(noise, 0.3, 20.0), DEFAULT_NOISE_BGR)
        self.noise_bgr: NDArray[np.float32] = noise.astype(np.float32)
        """(3,) standard deviation of a pixel."""
        self.inverse_std: NDArray[np.float32] = (
            1.0 / np.sqrt((_BLOCK_NOISE_SHARE * noise) ** 2 + _ROUNDING_STD**2)
        ).astype(np.float32)
        """(3,) one over the noise of a block mean."""
        self.background: Blocks | None = None if background is None else block_means(background)
        """(1200, 3) block means of the background image."""
        if self.background is not None and self.background.max() < BLACK_LEVEL:
            raise FrameCorrupt("all black; check the LEDs and the cable of the sensor")
        if self.background is not None and self.background.min() > WHITE_LEVEL:
            raise FrameCorrupt("all white; check the exposure and the LEDs of the sensor")
        self._limit = gate_noise_factor**2
        x, y = np.meshgrid(np.linspace(-1, 1, BLOCKS_WIDE), np.linspace(-1, 1, BLOCKS_HIGH))
        drift = np.stack([np.ones(x.size), x.ravel(), y.ravel()], axis=1)
        self._drift: NDArray[np.float32] = np.linalg.qr(drift)[0].astype(np.float32)

    def changed(self, blocks: Blocks, before: Blocks, weight: NDArray[np.float32]) -> bool:
        """Return whether a block of weight 1, (1200,) 0 or 1, has changed by more than noise and an even light."""
        difference = blocks - before
        difference -= weight @ difference / max(float(weight.sum()), 1.0)
        difference *= self.inverse_std
        return bool((np.einsum("ij,ij->i", difference, difference) * weight).max() > 2.0 * self._limit)

    def may_be_contact(self, blocks: Blocks) -> bool:
        """Return False if only noise and a drift of the light (level and slope) separate (1200, 3) blocks from it."""
        if self.background is None:
            return True
        difference = blocks - self.background
        difference -= self._drift @ (self._drift.T @ difference)
        difference *= self.inverse_std
        return bool(np.einsum("ij,ij->i", difference, difference).max() > self._limit)


class ChangeDetector:
    """Compares one finger's image with the one kept from the last change, so that creep accumulates until it is seen.

    The difference is tested in units of the sensor's noise: its worst block, and the part of it that a rotation or a
    shift of this very image would cause, which detects far less than a degree.

    Args:
        gate: Of this unit; it knows noise and background image.
    """

    def __init__(self, gate: ContactGate) -> None:
        self._inverse_std, self._background = gate.inverse_std, gate.background
        y, x = np.mgrid[0:BLOCKS_HIGH, 0:BLOCKS_WIDE].astype(np.float32)
        self._x, self._y = x.ravel(), y.ravel()
        self.reset()

    def reset(self) -> None:
        """Forget the kept image: the next image counts as a change."""
        self._kept: Blocks = np.zeros(0, np.float32)
        self._count = 0
        self._since_s = math.inf
        self._motions: tuple[NDArray[np.float32], NDArray[np.float64]] | None = None

    def add(self, blocks: Blocks, near: NDArray[np.bool_] | None, now_s: float, unchanged: bool) -> None:
        """Add a measured image: average it with the kept one if unchanged, else keep it instead.

        Args:
            blocks: (1200, 3) block means.
            near: (1200,) bool, the blocks in and around the contact; None without contact.
            now_s: Capture time of the image.
            unchanged: The result of `unchanged` for this image.
        """
        if unchanged and self._count >= AVERAGED:
            return
        if unchanged and self._count:
            self._kept = self._kept + (blocks - self._kept) * np.float32(1.0 / (self._count + 1))
            self._count += 1
        else:
            self._kept, self._count, self._since_s = blocks, 1, now_s
            self._near = (np.ones(len(blocks), np.bool_) if near is None else near).astype(np.float32)
        self._motions = None

    def unchanged(self, blocks: Blocks) -> bool:
        """Return whether an image, (1200, 3) block means, differs from the kept one by no more than noise."""
        if not self._count:
            return False
        std = math.sqrt(1.0 + 1.0 / self._count)
        difference = self._without_flicker((blocks - self._kept) * self._inverse_std) / np.float32(std)
        if float(np.einsum("ij,ij->i", difference, difference).max()) > WORST_STD**2:
            return False
        motions, _ = self._motions = self._motions or self._find_motions()
        return bool(((motions @ difference.ravel()) ** 2 <= MOTION_STD**2 * _squares(motions)).all())

    def at_rest(self, now_s: float, with_rotation: bool) -> bool:
        """Return whether the image has been unchanged for a while, and a small motion would be detected in it.

        with_rotation: not only a shift, but also a rotation.
        """
        if self._count < AVERAGED or not now_s - self._since_s >= QUIET_S:
            return False
        # The strength of a motion contains the noise of the image itself, which is no signal.
        motions, own2 = self._motions = self._motions or self._find_motions()
        signal2 = _squares(motions) - own2
        needed = np.array([math.radians(SENSITIVE_DEG), SENSITIVE_BLOCKS, SENSITIVE_BLOCKS]) ** 2
        return bool((signal2 * needed > MOTION_STD**2)[0 if with_rotation else 1 :].all())

    def _without_flicker(self, difference: Blocks) -> Blocks:
        """Remove the mean away from the contact (light), then that of each column: columns of a DIGIT flicker."""
        away = 1.0 - self._near
        difference -= away @ difference / max(float(away.sum()), 1.0)
        image, weight = difference.reshape(BLOCKS_HIGH, BLOCKS_WIDE, 3), away.reshape(BLOCKS_HIGH, BLOCKS_WIDE, 1)
        image -= (weight * image).sum(axis=0) / (weight.sum(axis=0) + np.float32(COLUMN_PRIOR))
        return difference

    def _find_motions(self) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
        """Return the change of the image by a rotation (rad) and by shifts right and down (blocks), (3, 3600).

        Also what noise contributes to their squares, (3,).
        """
        imprint = self._kept if self._background is None else self._kept - self._background
        image = (imprint * self._inverse_std).reshape(BLOCKS_HIGH, BLOCKS_WIDE, 3)
        down, right = np.gradient(image, axis=(0, 1))
        near = self._near.reshape(BLOCKS_HIGH, BLOCKS_WIDE, 1)
        mass = max(float(self._near.sum()), 1.0)
        x = (self._x - self._near @ self._x / mass).reshape(BLOCKS_HIGH, BLOCKS_WIDE, 1)
        y = (self._y - self._near @ self._y / mass).reshape(BLOCKS_HIGH, BLOCKS_WIDE, 1)
        motions = np.stack([near * (right * y - down * x), near * right, near * down]).reshape(3, -1)
        # A difference of two blocks over two: half of their noise.
        own2 = 1.5 / self._count * np.array([float((near * (x**2 + y**2)).sum()), mass, mass])
        return np.asarray(motions, np.float32), own2


def _squares(rows: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.asarray(np.einsum("ij,ij->i", rows, rows), np.float32)


def second_finger_can_skip(
    own: Estimate | None, other: Estimate | None, captured_at_s: float, refresh_s: float
) -> bool:
    """Return whether a finger's frame of `captured_at_s` need not be measured.

    Args:
        own: The finger's last estimate.
        other: The other finger's last estimate.
        captured_at_s: Capture time of the frame.
        refresh_s: Longest age of a repeated estimate at the next frame.

    Returns:
        False if `own` has no reference or the smaller sigma, if the fingers disagree, if the estimate would be too
        old, or if the other finger did not itself measure an unchanged image.
    """
    if own is None or other is None or not (own.contact and other.contact):
        return False
    if other.skipped != UNCHANGED or other.sigma_deg is None or not own.has_reference:
        return False
    if own.sigma_deg is not None and own.sigma_deg < other.sigma_deg:
        return False
    if _disagree(own, other):
        return False
    next_s = 2.0 * captured_at_s - own.captured_at_s
    recent = own.measured_at_s <= captured_at_s and next_s - own.measured_at_s <= refresh_s
    return recent and abs(captured_at_s - other.captured_at_s) <= MAX_FRAME_GAP_S


def repeat_estimate(own: Estimate, captured_at_s: float, sequence: int) -> Estimate:
    """Return the last estimate for a skipped frame; `measured_at_s` stays."""
    return replace(own, sequence=sequence, captured_at_s=captured_at_s, skipped=OTHER_FINGER, stage_ms={})


def _disagree(own: Estimate, other: Estimate) -> bool:
    """Return whether the fingers report different rotations; the two images see one rotation with opposite signs."""
    if own.rotation_deg is None or own.sigma_deg is None or other.rotation_deg is None or other.sigma_deg is None:
        return False
    apart_deg = abs(own.rotation_deg + other.rotation_deg)
    return apart_deg > max(DISAGREE_DEG, DISAGREE_SIGMAS * math.hypot(own.sigma_deg, other.sigma_deg))
