"""The contact gate: skips the segmentation network for frames that show no contact.

The gate compares 30 x 40 block means (8 x 8 pixels each) with the background image: in a mean the camera's noise is
small and known. A wrong "maybe contact" costs two milliseconds, a wrong "no contact" costs the object, so the gate
prefers the first.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.devices import FRAME_HEIGHT_PX, FRAME_WIDTH_PX
from slipguard.errors import FrameCorrupt

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

Blocks = NDArray[np.float32]


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
