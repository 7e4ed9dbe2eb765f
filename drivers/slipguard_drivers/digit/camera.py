"""A DIGIT over V4L2: found by its serial number, frames with the kernel's time, the newest one wins."""

from __future__ import annotations

import asyncio
import errno
from pathlib import Path
from typing import Annotated, Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from slipguard.devices import FRAME_HEIGHT_PX, FRAME_WIDTH_PX, DriverContext, Frame, TactileSensor
from slipguard.errors import DeviceLost
from slipguard_drivers.digit.stream import FrameStream
from slipguard_drivers.digit.v4l2 import ZOOM_ABSOLUTE, Capture, Delivery

BY_ID = Path("/dev/v4l/by-id")
WIRE_WIDTH_PX, WIRE_HEIGHT_PX = FRAME_HEIGHT_PX, FRAME_WIDTH_PX  # landscape on the wire
EMPTY_WAKE_UPS = 100
"""Wake-ups in a row without a frame after which a device in error is given up; else it would spin for ever."""

Level = Annotated[int, Field(ge=0, le=15)]


class DigitSensor(TactileSensor):
    """One DIGIT on USB."""

    class Settings(BaseModel):
        """serial: as printed on the sensor, D followed by five digits."""

        model_config = ConfigDict(frozen=True, extra="forbid")

        serial: Annotated[str, Field(pattern=r"^[A-Za-z0-9]+$")]
        fps: Literal[30, 60] = 60
        led_rgb: tuple[Level, Level, Level] = (15, 15, 15)
        stall_ms: Annotated[float, Field(ge=50.0, le=5000.0)] = 250.0

    def __init__(self, settings: Settings, context: DriverContext) -> None:
        self._name = context.name
        self._settings = settings
        self._capture: Capture | None = None
        self._stream: FrameStream | None = None
        self._empty_wake_ups = 0

    @property
    def serial(self) -> str:
        """As configured; `open` finds the sensor by it."""
        return self._settings.serial

    async def open(self) -> None:
        """Find the sensor, set format, rate and LEDs, start the stream."""
        if self._stream is not None and not self._stream.lost:
            return
        await self.close()
        path = find_digit(self.serial, self._name, BY_ID)
        try:
            capture = Capture(str(path), WIRE_WIDTH_PX, WIRE_HEIGHT_PX, self._settings.fps, "YUYV")
        except OSError as error:
            raise DeviceLost(f"{self._name}: {path} cannot be used: {_reason(error)}") from error
        try:
            capture.set_control(ZOOM_ABSOLUTE, led_level(*self._settings.led_rgb))
            capture.start()
        except OSError as error:
            capture.close()
            raise DeviceLost(f"{self._name}: {path} does not start: {_reason(error)}") from error
        self._capture = capture
        self._stream = FrameStream(self._name, self._settings.stall_ms / 1000.0)
        self._empty_wake_ups = 0
        asyncio.get_running_loop().add_reader(capture.fileno(), self._on_readable)

    async def next_frame(self) -> Frame:
        """The newest frame not yet handed out."""
        if self._stream is None:
            raise DeviceLost(f"{self._name}: the sensor is not open; open it first")
        return await self._stream.next()

    async def close(self) -> None:
        """Stop the stream and let go of the device."""
        self._let_go()
        self._stream = None

    def _let_go(self) -> None:
        if self._capture is not None:
            asyncio.get_running_loop().remove_reader(self._capture.fileno())
            self._capture.close()
            self._capture = None

    def _on_readable(self) -> None:
        """Drain what waits in the driver and keep the newest."""
        assert self._capture is not None
        assert self._stream is not None
        newest: Delivery | None = None
        try:
            while (delivery := self._capture.take()) is not None:
                newest = delivery
        except OSError as error:
            self._let_go()
            self._stream.lose(f"the sensor is gone ({_reason(error)})")
            return
        if newest is not None:
            self._empty_wake_ups = 0
            self._deliver(newest)
            return
        self._empty_wake_ups += 1
        if self._empty_wake_ups >= EMPTY_WAKE_UPS:
            self._let_go()
            self._stream.lose("the camera driver signals an error and delivers nothing")

    def _deliver(self, delivery: Delivery) -> None:
        assert self._stream is not None
        if delivery.damaged:
            self._stream.damaged(f"{len(delivery.data)} bytes with the driver's error flag or of the wrong size")
            return
        captured_at_s = delivery.captured_at_s
        if captured_at_s is None:
            captured_at_s = asyncio.get_running_loop().time()
        self._stream.put(upright(delivery.data), captured_at_s, delivery.sequence)


def upright(yuyv: bytes) -> NDArray[np.uint8]:
    """A landscape YUYV picture (320 x 240) as the portrait BGR image (240 x 320) the field works with.

    Turned 90 degrees counter-clockwise, as Facebook's digit-interface shows it.
    """
    packed = np.frombuffer(yuyv, np.uint8).reshape(WIRE_HEIGHT_PX, WIRE_WIDTH_PX, 2)
    landscape = cv2.cvtColor(packed, cv2.COLOR_YUV2BGR_YUYV)
    return np.asarray(cv2.rotate(landscape, cv2.ROTATE_90_COUNTERCLOCKWISE), dtype=np.uint8)


def led_level(red: int, green: int, blue: int) -> int:
    """The zoom control's value for LED levels of 0-15 each: the DIGIT's firmware misuses zoom for its LEDs."""
    return red << 8 | green << 4 | blue


def find_digit(serial: str, name: str, folder: Path) -> Path:
    """The capture node of the DIGIT with this serial number. Raises DeviceLost naming those there are."""
    nodes = sorted(folder.glob("*DIGIT_*-video-index0")) if folder.is_dir() else []
    for node in nodes:
        if node.name.endswith(f"_{serial}-video-index0"):
            return node
    there = [node.name.removesuffix("-video-index0").rsplit("_", 1)[-1] for node in nodes]
    raise DeviceLost(
        f"{name}: no DIGIT with serial {serial} is plugged in; there "
        + (f"is {', '.join(there)}" if there else "is none at all: check the USB cable")
    )


def _reason(error: OSError) -> str:
    known = {
        errno.ENODEV: "it was unplugged",
        errno.EBUSY: "another program is using it",
        errno.EACCES: "access is denied; the user must be in the group video",
        errno.ENOSPC: "the USB bus has no bandwidth left; plug the sensors into different host ports",
    }
    return known.get(error.errno or 0) or error.strerror or str(error)
