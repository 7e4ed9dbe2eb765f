"""A capture device made of a pipe: for the DIGIT driver without a kernel that has cameras."""

from __future__ import annotations

import os
from collections import deque
from pathlib import Path

import numpy as np

from slipguard_drivers.digit.capture import RawFrame, VideoMode
from slipguard_drivers.digit.discovery import DigitDevice

FRAME_BYTES = 320 * 240 * 2
DIGIT_MODES = (
    VideoMode("YUYV", 640, 480, 30.0),
    VideoMode("YUYV", 640, 480, 15.0),
    VideoMode("YUYV", 320, 240, 60.0),
    VideoMode("YUYV", 320, 240, 30.0),
)


class PipeCapture:
    """Readable while `queue` holds something; None in it is a wake-up without a frame.

    The class is the device: what it offers, gives and refuses is set there.
    """

    last: PipeCapture
    offers: tuple[VideoMode, ...] = DIGIT_MODES
    gives_fps: float | None = None
    zoom_max: int | None = 0xFFF
    refuses: OSError | None = None
    refuses_to_start: OSError | None = None

    def __init__(self, path: str) -> None:
        if self.refuses is not None:
            raise self.refuses
        self.path = Path(path)
        self.mode: VideoMode | None = None
        self.zoom: int | None = None
        self.queue: deque[RawFrame | OSError | None] = deque()
        self.started = False
        self.closed = False
        self.error_for_ever = False
        self._out, self._in = os.pipe()
        os.set_blocking(self._out, False)
        PipeCapture.last = self

    def fileno(self) -> int:
        return self._out

    def modes(self, width_px: int | None = None, height_px: int | None = None) -> list[VideoMode]:
        return [
            mode for mode in self.offers if width_px in (None, mode.width_px) and height_px in (None, mode.height_px)
        ]

    def configure(self, mode: VideoMode) -> VideoMode:
        given = VideoMode(
            mode.pixels, mode.width_px, mode.height_px, self.gives_fps if self.gives_fps is not None else mode.fps
        )
        self.mode = mode
        return given

    def set_control(self, control: int, value: int) -> int:
        if self.zoom_max is None:
            raise OSError(22, "Invalid argument")
        self.zoom = min(value, self.zoom_max)
        return self.zoom

    def start(self) -> None:
        if self.refuses_to_start is not None:
            raise self.refuses_to_start
        self.started = True

    def offer(self, *items: RawFrame | OSError | None) -> None:
        self.queue.extend(items)
        os.write(self._in, b"!")

    def take(self) -> RawFrame | None:
        if not self.queue:
            if not self.error_for_ever and self._out >= 0:
                os.read(self._out, 4096)
            return None
        item = self.queue.popleft()
        if isinstance(item, OSError):
            raise item
        return item

    def close(self) -> None:
        if not self.closed:
            self.closed = True
            os.close(self._out)
            os.close(self._in)


def delivery(sequence: int, *, damage: str | None = None, captured_at_s: float | None = None) -> RawFrame:
    """A frame of noise."""
    pixels = np.random.default_rng(sequence).integers(0, 256, FRAME_BYTES, np.uint8)
    return RawFrame(pixels.tobytes(), sequence, captured_at_s, damage)


def found(serial: str, name: str, firmware: int = 212) -> DigitDevice:
    """As `find_digit` would: the sensor asked for is there."""
    return DigitDevice(Path("/dev/video7"), serial, firmware, "1-2", 480.0)
