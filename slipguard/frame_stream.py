"""The last step of every tactile sensor: the newest frame wins, and no frame is returned twice."""

from __future__ import annotations

import asyncio

import numpy as np
from numpy.typing import NDArray

from slipguard.devices import Frame, wrong_image
from slipguard.errors import DeviceError, DeviceLost, DeviceTimeout, FrameCorrupt, FrameFrozen

BLACK, WHITE = 2, 253
NOISE_SHARE_MIN = 0.01
"""Share of values between black and white from which on frames cannot be equal by chance: 2,300 values with noise."""
FROZEN_AFTER = 3
"""Repetitions in a row that count as a frozen camera. Fewer are the duplicates that USB cameras deliver now and then;
they are skipped. Noise (1.5-2.9 gray levels) keeps real frames from being identical."""


class FrameStream:
    """Takes the frames of a camera and returns the newest of them, once.

    stall_s: how long `next` waits for a frame before it raises DeviceTimeout.
    """

    def __init__(self, name: str, stall_s: float) -> None:
        self._name = name
        self._stall_s = stall_s
        self._arrived = asyncio.Event()
        self._newest: Frame | DeviceError | None = None
        self._lost: str | None = None
        self._last: Frame | None = None
        self._returned: Frame | None = None
        self._repeats = 0

    @property
    def lost(self) -> bool:
        """Whether the camera is gone."""
        return self._lost is not None

    def put(self, image: NDArray[np.uint8], captured_at_s: float, sequence: int) -> None:
        """Take a frame. image: (320, 240, 3) uint8 BGR; it becomes read-only and is not copied."""
        wrong = wrong_image(image)
        if wrong is not None:
            self.damaged(f"the image is {wrong}")
            return
        last = self._last
        if last is not None and sequence < last.sequence:
            return  # a newer frame arrived before
        if last is not None and (sequence == last.sequence or self._is_repeated(image)):
            self._repeats += 1
            if self._repeats >= FROZEN_AFTER:
                what = "sequence number" if sequence == last.sequence else "pixels"
                self._set_newest(
                    FrameFrozen(
                        f"{self._name}: the camera repeats itself: {self._repeats} frames with the same {what} "
                        f"(limit {FROZEN_AFTER}); open it again"
                    )
                )
            return
        self._repeats = 0
        image.flags.writeable = False
        self._last = Frame(image=image, captured_at_s=captured_at_s, sequence=sequence)
        self._set_newest(self._last)

    def damaged(self, why: str) -> None:
        """Report a frame that arrived but cannot be used."""
        self._set_newest(FrameCorrupt(f"{self._name}: damaged frame: {why}"))

    def lose(self, why: str) -> None:
        """Report that the camera is gone: from now on, `next` raises DeviceLost."""
        if self._lost is None:
            self._lost = why
        self._arrived.set()

    async def next(self) -> Frame:
        """Wait for the newest frame that was not returned before.

        Raises:
            DeviceTimeout: if nothing arrives for `stall_s`.
            FrameCorrupt: if the newest frame is damaged.
            FrameFrozen: if the camera repeats itself.
            DeviceLost: if the camera is gone.
        """
        while True:
            if self._lost is not None:
                raise DeviceLost(f"{self._name}: {self._lost}")
            newest, self._newest = self._newest, None
            self._arrived.clear()
            if isinstance(newest, DeviceError):
                raise newest
            if newest is not None:
                self._returned = newest
                return newest
            try:
                async with asyncio.timeout(self._stall_s):
                    await self._arrived.wait()
            except TimeoutError:
                raise DeviceTimeout(
                    f"{self._name}: no frame for {self._stall_s * 1000:.0f} ms; check the camera's cable and the load "
                    "of this machine"
                ) from None

    def _is_repeated(self, image: NDArray[np.uint8]) -> bool:
        """Return whether the image equals the last one, or the last one that was returned.

        A black or white image has no noise in which two frames differ: it is returned, and its light is checked.
        """
        same = any(frame is not None and _equal(image, frame.image) for frame in (self._last, self._returned))
        return same and bool(np.count_nonzero((image > BLACK) & (image < WHITE)) > NOISE_SHARE_MIN * image.size)

    def _set_newest(self, newest: Frame | DeviceError) -> None:
        self._newest = newest
        self._arrived.set()


def _equal(image: NDArray[np.uint8], other: NDArray[np.uint8]) -> bool:
    """Return whether two images are equal. One row is enough to distinguish most images."""
    middle = len(image) // 2
    return np.array_equal(image[middle], other[middle]) and np.array_equal(image, other)
