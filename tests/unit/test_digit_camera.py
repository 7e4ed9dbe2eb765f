"""The DIGIT driver over a capture device made of a pipe: newest wins, and every way to lose a camera is told."""

from __future__ import annotations

import asyncio
import errno
import os
from collections import deque
from collections.abc import AsyncIterator
from pathlib import Path

import numpy as np
import pytest

from slipguard.devices import DriverContext
from slipguard.errors import DeviceLost, DeviceTimeout, FrameCorrupt
from slipguard_drivers.digit import camera
from slipguard_drivers.digit.camera import DigitSensor
from slipguard_drivers.digit.v4l2 import ZOOM_ABSOLUTE, Delivery

FRAME_BYTES = 320 * 240 * 2


class PipeCapture:
    """Readable while `queue` holds something; None in it is a wake-up without a frame."""

    last: PipeCapture
    refuses: OSError | None = None

    def __init__(self, path: str, width: int, height: int, fps: int, pixels: str) -> None:
        if self.refuses is not None:
            raise self.refuses
        self.asked_for = (Path(path).name, width, height, fps, pixels)
        self.controls: dict[int, int] = {}
        self.queue: deque[Delivery | OSError | None] = deque()
        self.started = False
        self.error_for_ever = False
        self._out, self._in = os.pipe()
        os.set_blocking(self._out, False)
        PipeCapture.last = self

    def fileno(self) -> int:
        return self._out

    def set_control(self, control: int, value: int) -> None:
        self.controls[control] = value

    def start(self) -> None:
        self.started = True

    def offer(self, *items: Delivery | OSError | None) -> None:
        self.queue.extend(items)
        os.write(self._in, b"!")

    def take(self) -> Delivery | None:
        if not self.queue:
            if not self.error_for_ever and self._out >= 0:
                os.read(self._out, 4096)
            return None
        item = self.queue.popleft()
        if isinstance(item, OSError):
            raise item
        return item

    def close(self) -> None:
        os.close(self._out)
        os.close(self._in)
        self._out = -1


def delivery(sequence: int, *, damaged: bool = False, captured_at_s: float | None = None) -> Delivery:
    pixels = np.random.default_rng(sequence).integers(0, 256, FRAME_BYTES, np.uint8)
    return Delivery(pixels.tobytes(), sequence, captured_at_s, damaged)


@pytest.fixture
def plugged_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    node = tmp_path / "usb-Facebook_DIGIT_D20001-video-index0"
    node.touch()
    monkeypatch.setattr(camera, "BY_ID", tmp_path)
    monkeypatch.setattr(camera, "Capture", PipeCapture)
    return node


@pytest.fixture
async def sensor(plugged_in: Path) -> AsyncIterator[DigitSensor]:
    settings = DigitSensor.Settings(serial="D20001", led_rgb=(15, 7, 3), stall_ms=100)
    sensor = DigitSensor(settings, DriverContext("left"))
    await sensor.open()
    yield sensor
    await sensor.close()


async def test_it_asks_for_the_landscape_stream_and_sets_the_leds(sensor: DigitSensor, plugged_in: Path) -> None:
    assert PipeCapture.last.asked_for == (plugged_in.name, 320, 240, 60, "YUYV")
    assert PipeCapture.last.controls == {ZOOM_ABSOLUTE: 0xF73}
    assert PipeCapture.last.started


async def test_the_newest_of_what_waits_is_handed_out(sensor: DigitSensor) -> None:
    PipeCapture.last.offer(delivery(1), delivery(2, captured_at_s=12.5))
    frame = await sensor.next_frame()
    assert (frame.sequence, frame.captured_at_s) == (2, 12.5)
    assert frame.image.shape == (320, 240, 3)
    with pytest.raises(DeviceTimeout):
        await sensor.next_frame()


async def test_a_driver_without_monotonic_time_gets_the_time_of_arrival(sensor: DigitSensor) -> None:
    before_s = asyncio.get_running_loop().time()
    PipeCapture.last.offer(delivery(1))
    assert before_s <= (await sensor.next_frame()).captured_at_s <= asyncio.get_running_loop().time()


async def test_a_damaged_frame_is_told(sensor: DigitSensor) -> None:
    PipeCapture.last.offer(delivery(1), delivery(2, damaged=True))
    with pytest.raises(FrameCorrupt):
        await sensor.next_frame()


async def test_an_unplugged_camera_is_lost_and_opened_again(sensor: DigitSensor) -> None:
    first = PipeCapture.last
    waiting = asyncio.ensure_future(sensor.next_frame())
    await asyncio.sleep(0)
    first.offer(OSError(errno.ENODEV, "No such device"))
    with pytest.raises(DeviceLost, match="unplugged"):
        await waiting
    with pytest.raises(DeviceLost):
        await sensor.next_frame()
    await sensor.open()
    assert PipeCapture.last is not first
    PipeCapture.last.offer(delivery(1))
    assert (await sensor.next_frame()).sequence == 1


async def test_a_device_in_error_for_ever_does_not_spin_for_ever(sensor: DigitSensor) -> None:
    PipeCapture.last.error_for_ever = True
    PipeCapture.last.offer(None)
    with pytest.raises(DeviceLost, match="delivers nothing"):
        await asyncio.wait_for(_until_lost(sensor), 2.0)


@pytest.mark.parametrize(
    ("error", "told"),
    [
        (OSError(errno.EBUSY, "busy"), "another program"),
        (OSError(errno.EACCES, "denied"), "group video"),
        (OSError(errno.EINVAL, "it gives 640x480 MJPG"), "it gives 640x480 MJPG"),
    ],
)
async def test_a_camera_that_cannot_be_used_says_why(
    plugged_in: Path, monkeypatch: pytest.MonkeyPatch, error: OSError, told: str
) -> None:
    monkeypatch.setattr(PipeCapture, "refuses", error)
    sensor = DigitSensor(DigitSensor.Settings(serial="D20001"), DriverContext("left"))
    with pytest.raises(DeviceLost, match=told):
        await sensor.open()
    await sensor.close()


async def _until_lost(sensor: DigitSensor) -> None:
    while True:
        try:
            await sensor.next_frame()
        except DeviceTimeout:
            continue
