"""Sizes, offsets and request codes of V4L2 as <linux/videodev2.h> has them on 64-bit Linux."""

from __future__ import annotations

import struct

import cv2
import numpy as np
import pytest

from slipguard.devices import DriverContext
from slipguard.errors import DeviceLost
from slipguard_drivers.digit import v4l2
from slipguard_drivers.digit.camera import DigitSensor, find_digit, led_level, upright


@pytest.mark.parametrize(
    ("layout", "size"),
    [
        (v4l2.FORMAT, 208),
        (v4l2.FORMAT_DESCRIPTION, 64),
        (v4l2.STREAM_PARAMETERS, 204),
        (v4l2.BUFFER_REQUEST, 20),
        (v4l2.BUFFER, 88),
        (v4l2.CONTROL, 8),
    ],
)
def test_sizes(layout: struct.Struct, size: int) -> None:
    assert layout.size == size


@pytest.mark.parametrize(
    ("layout", "field", "offset"),
    [
        (v4l2.FORMAT, 1, 8),  # pix.width
        (v4l2.FORMAT, 6, 28),  # pix.sizeimage
        (v4l2.STREAM_PARAMETERS, 3, 12),  # capture.timeperframe
        (v4l2.FORMAT_DESCRIPTION, 4, 44),  # pixelformat
        (v4l2.BUFFER_REQUEST, 2, 8),  # memory
        (v4l2.BUFFER, 5, 24),  # timestamp
        (v4l2.BUFFER, 8, 56),  # sequence
        (v4l2.BUFFER, 10, 64),  # m.offset
        (v4l2.BUFFER, 11, 72),  # length
    ],
)
def test_offsets(layout: struct.Struct, field: int, offset: int) -> None:
    marked = bytearray(layout.size)
    marked[offset] = 1
    values = layout.unpack(bytes(marked))
    assert [index for index, value in enumerate(values) if value in (1, b"\1" + b"\0" * 15)] == [field]


def test_request_codes() -> None:
    codes = {
        "ENUM_FMT": 0xC0405602,
        "S_FMT": 0xC0D05605,
        "REQBUFS": 0xC0145608,
        "QUERYBUF": 0xC0585609,
        "QBUF": 0xC058560F,
        "DQBUF": 0xC0585611,
        "STREAMON": 0x40045612,
        "STREAMOFF": 0x40045613,
        "S_PARM": 0xC0CC5616,
        "S_CTRL": 0xC008561C,
    }
    assert {name: getattr(v4l2, name) for name in codes} == codes
    assert v4l2.fourcc("YUYV") == 0x56595559
    assert v4l2.fourcc_name(0x56595559) == "YUYV"


def test_the_picture_is_turned_counter_clockwise() -> None:
    landscape = np.full((240, 320, 2), 128, np.uint8)
    landscape[:, :, 0] = 16
    landscape[:40, -40:, 0] = 235  # bright at the top right
    portrait = upright(landscape.tobytes())
    assert portrait.shape == (320, 240, 3)
    assert portrait[:40, :40].min() > 250, "top right becomes top left"
    assert portrait[60:].max() < 5
    colour = cv2.cvtColor(landscape, cv2.COLOR_YUV2BGR_YUYV)
    assert np.array_equal(portrait, np.rot90(colour, 1))


def test_led_levels_share_the_zoom_control() -> None:
    assert led_level(15, 15, 15) == 0xFFF
    assert led_level(15, 7, 3) == 0xF73


def test_a_digit_is_found_by_its_serial(tmp_path) -> None:
    for serial in ("D20001", "D20002"):
        for index in (0, 1):
            (tmp_path / f"usb-Facebook_DIGIT_{serial}-video-index{index}").touch()
    assert find_digit("D20002", "left", tmp_path).name == "usb-Facebook_DIGIT_D20002-video-index0"
    with pytest.raises(DeviceLost, match="there is D20001, D20002"):
        find_digit("D2", "left", tmp_path)
    with pytest.raises(DeviceLost, match="none at all"):
        find_digit("D20001", "left", tmp_path / "nowhere")


async def test_without_a_digit_open_says_so_and_close_is_harmless() -> None:
    sensor = DigitSensor(DigitSensor.Settings(serial="D00000"), DriverContext("left"))
    with pytest.raises(DeviceLost, match="D00000"):
        await sensor.open()
    with pytest.raises(DeviceLost):
        await sensor.next_frame()
    await sensor.close()
