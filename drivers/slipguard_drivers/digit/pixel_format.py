"""From what a DIGIT sends, a landscape picture of 320 x 240, to the portrait BGR image the field works with.

Turned 90 degrees counter-clockwise, as Facebook's digit-interface shows it.
"""

from __future__ import annotations

import struct

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.devices import FRAME_HEIGHT_PX, FRAME_WIDTH_PX

WIRE_WIDTH_PX, WIRE_HEIGHT_PX = FRAME_HEIGHT_PX, FRAME_WIDTH_PX
PADDING_MAX_BYTES = 4096
"""Zeros that cameras append to fill their last packet."""

Image = NDArray[np.uint8]


class DamagedFrame(Exception):
    """What was sent is no whole picture; str() says what is wrong with it."""


def decode_yuyv(data: bytes) -> Image:
    """(320, 240, 3) uint8 BGR. Raises DamagedPicture for a wrong number of bytes."""
    expected = WIRE_WIDTH_PX * WIRE_HEIGHT_PX * 2
    if len(data) != expected:
        raise DamagedFrame(f"{len(data)} bytes instead of {expected}")
    packed = np.frombuffer(data, np.uint8).reshape(WIRE_HEIGHT_PX, WIRE_WIDTH_PX, 2)
    return _upright(np.asarray(cv2.cvtColor(packed, cv2.COLOR_YUV2BGR_YUYV), np.uint8))


def decode_jpeg(data: bytes) -> Image:
    """(320, 240, 3) uint8 BGR. Raises DamagedPicture for a JPEG that is cut off, of another size or not to be decoded.

    The decoder fills what is missing with grey and says nothing, so the file's structure is checked first.
    """
    check_jpeg(data)
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    if image is None:
        raise DamagedFrame(f"a JPEG of {len(data)} bytes that cannot be decoded")
    return _upright(np.asarray(image, np.uint8))


def check_jpeg(data: bytes) -> None:
    """Walk through the JPEG's segments (ITU T.81, annex B): whole, of the right size, ended by its end marker."""
    if data[:2] != b"\xff\xd8":
        raise DamagedFrame(f"{len(data)} bytes that are no JPEG")
    at, sized = 2, False
    while True:
        if at + 4 > len(data) or data[at] != 0xFF:
            raise DamagedFrame(f"a JPEG broken at byte {at} of {len(data)}")
        marker, length = data[at + 1], int.from_bytes(data[at + 2 : at + 4], "big")
        if marker in (0xC0, 0xC1, 0xC2) and at + 9 <= len(data):
            height, width = struct.unpack_from(">HH", data, at + 5)
            if (width, height) != (WIRE_WIDTH_PX, WIRE_HEIGHT_PX):
                raise DamagedFrame(f"a JPEG of {width}x{height} instead of {WIRE_WIDTH_PX}x{WIRE_HEIGHT_PX}")
            sized = True
        at += 2 + length
        if marker == 0xDA:
            break
    end = data.rfind(b"\xff\xd9", at)
    if not sized or end < 0 or len(data) - end - 2 > PADDING_MAX_BYTES or data[end + 2 :].strip(b"\0"):
        raise DamagedFrame(f"a JPEG of {len(data)} bytes without its end")


def _upright(landscape: Image) -> Image:
    return np.asarray(cv2.rotate(landscape, cv2.ROTATE_90_COUNTERCLOCKWISE), np.uint8)
