"""Structures, request codes and constants of <linux/videodev2.h>, in the 64-bit layout."""

from __future__ import annotations

import struct

FORMAT = struct.Struct("=I4x12I152x")
FORMAT_DESCRIPTION = struct.Struct("=III32sI16x")
FRAME_SIZE = struct.Struct("=III6I8x")
FRAME_INTERVAL = struct.Struct("=IIIII6I8x")
STREAM_PARAMETERS = struct.Struct("=I4I184x")
BUFFER_REQUEST = struct.Struct("=IIII4x")
BUFFER = struct.Struct("=5I4xqq16sIIQII8x")
CONTROL = struct.Struct("=Ii")

CAPTURE = 1
MEMORY_MMAP = 1
DISCRETE = 1
FLAG_ERROR = 0x40
TIMESTAMP_MASK, TIMESTAMP_MONOTONIC = 0xE000, 0x2000
ZOOM_ABSOLUTE = 0x009A090D

_WRITE, _READ = 1, 2


def request_code(direction: int, number: int, size: int) -> int:
    """Return an ioctl number of V4L2, composed as in <asm-generic/ioctl.h>."""
    return direction << 30 | size << 16 | ord("V") << 8 | number


ENUM_FMT = request_code(_READ | _WRITE, 2, FORMAT_DESCRIPTION.size)
S_FMT = request_code(_READ | _WRITE, 5, FORMAT.size)
REQBUFS = request_code(_READ | _WRITE, 8, BUFFER_REQUEST.size)
QUERYBUF = request_code(_READ | _WRITE, 9, BUFFER.size)
QBUF = request_code(_READ | _WRITE, 15, BUFFER.size)
DQBUF = request_code(_READ | _WRITE, 17, BUFFER.size)
STREAMON = request_code(_WRITE, 18, 4)
STREAMOFF = request_code(_WRITE, 19, 4)
S_PARM = request_code(_READ | _WRITE, 22, STREAM_PARAMETERS.size)
G_CTRL = request_code(_READ | _WRITE, 27, CONTROL.size)
S_CTRL = request_code(_READ | _WRITE, 28, CONTROL.size)
ENUM_FRAMESIZES = request_code(_READ | _WRITE, 74, FRAME_SIZE.size)
ENUM_FRAMEINTERVALS = request_code(_READ | _WRITE, 75, FRAME_INTERVAL.size)


def fourcc(name: str) -> int:
    """Return the number of a pixel format such as "YUYV"."""
    return int(struct.unpack("<I", name.encode("ascii"))[0])


def fourcc_name(number: int) -> str:
    """Return the name of a pixel format."""
    return struct.pack("<I", number).decode("ascii", "replace").rstrip()
