"""Sizes, offsets and request codes of V4L2 as <linux/videodev2.h> has them on 64-bit Linux."""

from __future__ import annotations

import struct

import pytest

from slipguard_drivers.digit import v4l2
from slipguard_drivers.digit.capture import buffer


@pytest.mark.parametrize(
    ("layout", "size"),
    [
        (v4l2.FORMAT, 208),
        (v4l2.FORMAT_DESCRIPTION, 64),
        (v4l2.FRAME_SIZE, 44),
        (v4l2.FRAME_INTERVAL, 52),
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
        (v4l2.FRAME_SIZE, 3, 12),  # discrete.width
        (v4l2.FRAME_INTERVAL, 5, 20),  # discrete.numerator
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
        "G_CTRL": 0xC008561B,
        "S_CTRL": 0xC008561C,
        "ENUM_FRAMESIZES": 0xC02C564A,
        "ENUM_FRAMEINTERVALS": 0xC034564B,
    }
    assert {name: getattr(v4l2, name) for name in codes} == codes
    assert v4l2.fourcc("YUYV") == 0x56595559
    assert v4l2.fourcc_name(0x56595559) == "YUYV"


def test_a_request_about_a_buffer() -> None:
    asked = bytes(buffer(3))
    assert asked == struct.pack("<II52xI24x", 3, 1, 1), "index 3, capture, memory-mapped"
