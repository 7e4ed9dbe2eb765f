"""The DIGIT driver over a capture device made of a pipe: newest wins, and every way to lose a camera is reported."""

from __future__ import annotations

import asyncio
import errno
import sys
from collections.abc import AsyncIterator, Callable

import cv2
import numpy as np
import pytest
from pipe_capture import PipeCapture, delivery, found

from slipguard.devices import DriverContext
from slipguard.errors import DeviceLost, DeviceTimeout, FrameCorrupt
from slipguard_drivers.digit import decoding
from slipguard_drivers.digit.camera import DigitSensor
from slipguard_drivers.digit.capture import RawFrame, VideoMode

Camera: type[PipeCapture] = PipeCapture


def jpeg(sequence: int, *, cut: int = 0) -> RawFrame:
    smooth = np.random.default_rng(sequence).integers(0, 256, (15, 20, 3), np.uint8)
    data = cv2.imencode(".jpg", cv2.resize(smooth, (320, 240)))[1].tobytes()
    return RawFrame(data[: len(data) - cut], sequence, 1.0 + sequence / 60.0, None)


def digit(**settings: object) -> DigitSensor:
    wanted = {"serial": "D20001", "stall_ms": 1000} | settings
    return DigitSensor(DigitSensor.Settings.model_validate(wanted), DriverContext("left"), found, Camera)


@pytest.fixture(autouse=True)
def camera(monkeypatch: pytest.MonkeyPatch) -> type[PipeCapture]:
    """The device that the next sensor finds: a class of its own for each test to set up."""

    class Fresh(PipeCapture):
        pass

    monkeypatch.setattr(sys.modules[__name__], "Camera", Fresh)
    return Fresh


@pytest.fixture
async def sensor(camera: type[PipeCapture]) -> AsyncIterator[DigitSensor]:
    sensor = digit(led_rgb=(15, 7, 3))
    await sensor.open()
    yield sensor
    await sensor.close()


async def test_it_asks_for_the_landscape_stream_and_sets_the_leds(sensor: DigitSensor) -> None:
    assert PipeCapture.last.path.name == "video7"
    assert PipeCapture.last.mode == sensor.mode == VideoMode("YUYV", 320, 240, 60.0)
    assert PipeCapture.last.zoom == 0xF73
    assert PipeCapture.last.started
    assert sensor.remarks == ()


async def test_the_newest_waiting_frame_is_returned(sensor: DigitSensor) -> None:
    PipeCapture.last.offer(delivery(1), delivery(2, captured_at_s=12.5))
    frame = await sensor.next_frame()
    assert (frame.sequence, frame.captured_at_s) == (2, 12.5)
    assert frame.image.shape == (320, 240, 3)
    with pytest.raises(DeviceTimeout):
        await sensor.next_frame()


async def test_without_monotonic_time_the_arrival_time_is_used(sensor: DigitSensor) -> None:
    before_s = asyncio.get_running_loop().time()
    PipeCapture.last.offer(delivery(1))
    assert before_s <= (await sensor.next_frame()).captured_at_s <= asyncio.get_running_loop().time()


async def test_a_damaged_frame_is_reported(sensor: DigitSensor) -> None:
    PipeCapture.last.offer(delivery(1), delivery(2, damage="77 bytes instead of 153600"))
    with pytest.raises(FrameCorrupt, match="77 bytes"):
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
    assert first.closed
    assert PipeCapture.last is not first
    PipeCapture.last.offer(delivery(1))
    assert (await sensor.next_frame()).sequence == 1


async def test_a_device_in_permanent_error_is_lost(sensor: DigitSensor) -> None:
    PipeCapture.last.error_for_ever = True
    PipeCapture.last.offer(None)
    with pytest.raises(DeviceLost, match="delivers no frames"):
        await asyncio.wait_for(_until_lost(sensor), 2.0)


@pytest.mark.parametrize(
    ("error", "expected"),
    [
        (OSError(errno.EBUSY, "busy"), "another program"),
        (OSError(errno.EACCES, "denied"), "group video"),
        (OSError(errno.EINVAL, "it gives 640x480 MJPG"), "it gives 640x480 MJPG"),
    ],
)
async def test_an_unusable_camera_reports_the_reason(camera: type[PipeCapture], error: OSError, expected: str) -> None:
    camera.refuses = error
    sensor = digit()
    with pytest.raises(DeviceLost, match=expected):
        await sensor.open()
    await sensor.close()


async def test_missing_bus_bandwidth_is_reported_with_an_action(camera: type[PipeCapture]) -> None:
    camera.refuses_to_start = OSError(errno.ENOSPC, "No space left on device")
    with pytest.raises(DeviceLost, match=r"USB bus 1 .480 Mbit/s. has not enough bandwidth; use a port of another"):
        await digit().open()
    assert PipeCapture.last.closed


@pytest.mark.parametrize(
    ("refused", "chosen"), [({("YUYV", 60)}, ("MJPG", 60)), ({("YUYV", 60), ("MJPG", 60)}, ("MJPG", 30))]
)
async def test_with_little_bus_bandwidth_a_smaller_mode_is_used_and_remarked(
    camera: type[PipeCapture], refused: set[tuple[str, float]], chosen: tuple[str, float]
) -> None:
    def start(self: PipeCapture) -> None:
        if (self.mode.pixels, self.mode.fps) in refused:
            raise OSError(errno.ENOSPC, "No space left on device")

    camera.offers = [VideoMode(pixels, 320, 240, fps) for fps in (60.0, 30.0) for pixels in ("YUYV", "MJPG")]
    camera.start = start  # type: ignore[method-assign]
    sensor = digit()
    await sensor.open()
    assert (sensor.mode.pixels, sensor.mode.fps) == chosen
    assert "has not enough bandwidth for" in sensor.remarks[0]
    await sensor.close()


@pytest.mark.parametrize(
    ("offers", "settings", "chosen"),
    [
        ([("YUYV", 60), ("MJPG", 60)], {}, ("YUYV", 60)),
        ([("YUYV", 30), ("MJPG", 60)], {}, ("MJPG", 60)),
        ([("YUYV", 60), ("YUYV", 30)], {"fps": 30}, ("YUYV", 30)),
        ([("YUYV", 60), ("MJPG", 60)], {"pixels": "MJPG"}, ("MJPG", 60)),
        ([("YUYV", 0)], {}, ("YUYV", 60)),
    ],
)
async def test_the_requested_rate_is_used_if_offered(
    camera: type[PipeCapture], offers: list[tuple[str, float]], settings: dict[str, object], chosen: tuple[str, float]
) -> None:
    camera.offers = tuple(VideoMode(pixels, 320, 240, fps) for pixels, fps in offers)
    sensor = digit(**settings)
    await sensor.open()
    assert PipeCapture.last.mode == VideoMode(chosen[0], 320, 240, float(chosen[1]))
    assert sensor.remarks == ()
    await sensor.close()


async def test_a_camera_without_the_format_lists_its_modes(camera: type[PipeCapture]) -> None:
    camera.offers = (VideoMode("YUYV", 640, 480, 30.0), VideoMode("GREY", 320, 240, 60.0))
    with pytest.raises(
        DeviceLost, match="320x240 YUYV or MJPG is needed, it offers 640x480 YUYV at 30 frames per second, "
    ):
        await digit().open()
    assert PipeCapture.last.closed


@pytest.mark.parametrize(
    ("device", "settings", "expected"),
    [
        ({"gives_fps": 30.0}, {}, "the camera delivers 30 frames per second, 60 were requested"),
        ({"gives_fps": 0.0}, {}, "does not report its rate"),
        ({"zoom_max": None}, {}, "the LEDs cannot be set"),
        ({"zoom_max": 100}, {}, "the LEDs are set to 0x64 instead of 0xfff"),
    ],
)
async def test_differences_from_the_settings_are_reported(
    camera: type[PipeCapture], device: dict[str, object], settings: dict[str, object], expected: str
) -> None:
    for name, value in device.items():
        setattr(camera, name, value)
    sensor = digit(**settings)
    await sensor.open()
    (remark,) = sensor.remarks
    assert expected in remark
    await sensor.close()
    assert sensor.remarks == ()


async def test_too_few_frames_are_reported(sensor: DigitSensor) -> None:
    for number in range(100):
        PipeCapture.last.offer(delivery(number, captured_at_s=1.0 + number / 40.0))
    await sensor.next_frame()
    (remark,) = sensor.remarks
    assert "only 40 of 60 frames per second" in remark


@pytest.mark.parametrize(
    ("levels", "firmware", "zoom", "remarks"),
    [((15, 15, 15), 212, 0xFFF, 0), ((15, 7, 3), 200, 0xF73, 0), ((9, 9, 9), 199, 153, 0), ((15, 7, 3), 101, 255, 1)],
)
async def test_old_firmware_has_one_brightness(
    levels: tuple[int, int, int], firmware: int, zoom: int, remarks: int
) -> None:
    settings = DigitSensor.Settings(serial="D20001", led_rgb=levels)
    sensor = DigitSensor(settings, DriverContext("left"), lambda serial, name: found(serial, name, firmware), Camera)
    await sensor.open()
    assert PipeCapture.last.zoom == zoom
    assert len(sensor.remarks) == remarks
    await sensor.close()


async def test_jpeg_images_are_decoded_and_damaged_ones_reported(camera: type[PipeCapture]) -> None:
    camera.offers = (VideoMode("MJPG", 320, 240, 60.0),)
    sensor = digit(stall_ms=2000)
    await sensor.open()
    PipeCapture.last.offer(jpeg(1), jpeg(2))
    frame = await sensor.next_frame()
    assert (frame.sequence, frame.image.shape, frame.captured_at_s) == (2, (320, 240, 3), 1.0 + 2 / 60.0)
    PipeCapture.last.offer(jpeg(3, cut=200))
    with pytest.raises(FrameCorrupt, match="without its end"):
        await sensor.next_frame()
    PipeCapture.last.offer(jpeg(4))
    assert (await sensor.next_frame()).sequence == 4
    await sensor.close()


async def test_while_a_jpeg_is_decoded_only_the_newest_waits(
    camera: type[PipeCapture], monkeypatch: pytest.MonkeyPatch
) -> None:
    begun: list[bytes] = []
    monkeypatch.setattr(decoding, "decode_jpeg", lambda data: begun.append(data) or np.full((320, 240, 3), len(begun)))
    camera.offers = (VideoMode("MJPG", 320, 240, 60.0),)
    sensor = digit(stall_ms=2000)
    await sensor.open()
    images = [jpeg(number) for number in range(5)]
    assert sensor._decoder is not None
    for image in images:
        sensor._decoder.offer(image, 1.0)
    await _until(lambda: len(begun) == 2)
    assert begun == [images[0].data, images[4].data]
    await sensor.close()


async def test_a_cancelled_open_leaves_no_device_open(camera: type[PipeCapture]) -> None:
    sensor = digit()
    opening = asyncio.ensure_future(sensor.open())
    await asyncio.sleep(0)
    opening.cancel()
    with pytest.raises(asyncio.CancelledError):
        await opening
    await _until(lambda: (last := getattr(PipeCapture, "last", None)) is not None and last.closed)


async def test_without_a_digit_open_fails_and_close_does_nothing() -> None:
    sensor = DigitSensor(DigitSensor.Settings(serial="D00000"), DriverContext("left"))
    with pytest.raises(DeviceLost, match="D00000"):
        await sensor.open()
    with pytest.raises(DeviceLost):
        await sensor.next_frame()
    await sensor.close()


async def _until(condition: Callable[[], bool]) -> None:
    for _ in range(2000):
        if condition():
            return
        await asyncio.sleep(0.001)
    pytest.fail("it never came to that")


async def _until_lost(sensor: DigitSensor) -> None:
    while True:
        try:
            await sensor.next_frame()
        except DeviceTimeout:
            continue
