"""The last step of every tactile sensor: newest frame wins, nothing is handed out twice."""

from __future__ import annotations

import asyncio

import numpy as np
from numpy.typing import NDArray

from slipguard.devices import FRAME_HEIGHT_PX, FRAME_WIDTH_PX, Frame
from slipguard.errors import DeviceError, DeviceLost, DeviceTimeout, FrameCorrupt, FrameFrozen

SHAPE = (FRAME_HEIGHT_PX, FRAME_WIDTH_PX, 3)
FROZEN_AFTER = 3
"""Repetitions in a row that make a frozen camera. Fewer are the duplicates that USB cameras deliver now
and then, left out in silence. Noise (1.5-2.9 grey levels) keeps real frames from being identical."""


class FrameStream:
    """Takes what a camera delivers and hands out the newest of it, once.

    stall_s: how long `next` waits for a frame before it calls the stream stalled.
    """

    def __init__(self, name: str, stall_s: float) -> None:
        self._name = name
        self._stall_s = stall_s
        self._news = asyncio.Event()
        self._newest: Frame | DeviceError | None = None
        self._lost: str | None = None
        self._last: Frame | None = None
        self._handed: Frame | None = None
        self._repeats = 0

    @property
    def lost(self) -> bool:
        """Whether the camera behind it is gone."""
        return self._lost is not None

    def put(self, image: NDArray[np.uint8], captured_at_s: float, sequence: int) -> None:
        """Take a frame. image: (320, 240, 3) uint8 BGR, from now on read-only and not copied."""
        if image.shape != SHAPE or image.dtype != np.uint8:
            self.damaged(f"{image.dtype} pixels of shape {image.shape} instead of uint8 {SHAPE}")
            return
        last = self._last
        if last is not None and sequence < last.sequence:
            return  # overtaken by a newer one
        if last is not None and (sequence == last.sequence or self._is_old(image)):
            self._repeats += 1
            if self._repeats >= FROZEN_AFTER:
                what = "sequence number" if sequence == last.sequence else "pixels"
                self._tell(
                    FrameFrozen(
                        f"{self._name}: the camera repeats itself: {self._repeats} frames with the "
                        f"same {what}; open it again"
                    )
                )
            return
        self._repeats = 0
        image.flags.writeable = False
        self._last = Frame(image=image, captured_at_s=captured_at_s, sequence=sequence)
        self._tell(self._last)

    def _is_old(self, image: NDArray[np.uint8]) -> bool:
        """Whether it is the last picture again, or the last that was handed out, with others left out in between."""
        return any(one is not None and _same(image, one.image) for one in (self._last, self._handed))

    def damaged(self, why: str) -> None:
        """Take note of a frame that arrived but cannot be used."""
        self._tell(FrameCorrupt(f"{self._name}: damaged frame: {why}"))

    def lose(self, why: str) -> None:
        """The camera is gone: every `next` raises DeviceLost from now on."""
        if self._lost is None:
            self._lost = why
        self._news.set()

    def _tell(self, news: Frame | DeviceError) -> None:
        self._newest = news
        self._news.set()

    async def next(self) -> Frame:
        """Wait for the newest frame not yet handed out.

        Raises DeviceTimeout after `stall_s` without news, FrameCorrupt, FrameFrozen, DeviceLost.
        """
        while True:
            if self._lost is not None:
                raise DeviceLost(f"{self._name}: {self._lost}")
            newest, self._newest = self._newest, None
            self._news.clear()
            if isinstance(newest, DeviceError):
                raise newest
            if newest is not None:
                self._handed = newest
                return newest
            try:
                async with asyncio.timeout(self._stall_s):
                    await self._news.wait()
            except TimeoutError:
                raise DeviceTimeout(
                    f"{self._name}: no frame for {self._stall_s * 1000:.0f} ms; the stream stands still"
                ) from None


def _same(image: NDArray[np.uint8], other: NDArray[np.uint8]) -> bool:
    """Whether two pictures are equal. One row tells most of those that are not."""
    middle = len(image) // 2
    return np.array_equal(image[middle], other[middle]) and np.array_equal(image, other)
