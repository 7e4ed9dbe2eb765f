"""Decodes what a DIGIT sends, landscape images of 320 x 240, to portrait BGR images of 240 x 320.

The image is rotated by 90 degrees counter-clockwise, as Facebook's digit-interface does.
"""

from __future__ import annotations

import asyncio
import struct

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.devices import FRAME_HEIGHT_PX, FRAME_WIDTH_PX
from slipguard.frame_stream import FrameStream
from slipguard_drivers.digit.capture import RawFrame

WIRE_WIDTH_PX, WIRE_HEIGHT_PX = FRAME_HEIGHT_PX, FRAME_WIDTH_PX
PADDING_MAX_BYTES = 4096
"""Zeros that cameras append to fill their last packet."""

Image = NDArray[np.uint8]


class DamagedFrame(Exception):
    """The bytes are not a complete image; str() gives the reason."""


def decode_yuyv(data: bytes) -> Image:
    """Return the image, (320, 240, 3) uint8 BGR. Raises DamagedFrame for a wrong number of bytes."""
    expected = WIRE_WIDTH_PX * WIRE_HEIGHT_PX * 2
    if len(data) != expected:
        raise DamagedFrame(f"{len(data)} bytes instead of {expected}")
    packed = np.frombuffer(data, np.uint8).reshape(WIRE_HEIGHT_PX, WIRE_WIDTH_PX, 2)
    return _to_portrait(np.asarray(cv2.cvtColor(packed, cv2.COLOR_YUV2BGR_YUYV), np.uint8))


def decode_jpeg(data: bytes) -> Image:
    """Return the image, (320, 240, 3) uint8 BGR. Raises DamagedFrame if the JPEG is incomplete or of another size.

    OpenCV fills missing parts with gray without an error, so the file's structure is checked first.
    """
    check_jpeg(data)
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    if image is None:
        raise DamagedFrame(f"a JPEG of {len(data)} bytes that cannot be decoded")
    return _to_portrait(np.asarray(image, np.uint8))


def check_jpeg(data: bytes) -> None:
    """Raise DamagedFrame unless the JPEG's segments (ITU T.81, annex B) are complete and of the right image size."""
    if data[:2] != b"\xff\xd8":
        raise DamagedFrame(f"{len(data)} bytes that are not a JPEG")
    at, has_size = 2, False
    while True:
        if at + 4 > len(data) or data[at] != 0xFF:
            raise DamagedFrame(f"a JPEG broken at byte {at} of {len(data)}")
        marker, length = data[at + 1], int.from_bytes(data[at + 2 : at + 4], "big")
        if marker in (0xC0, 0xC1, 0xC2) and at + 9 <= len(data):
            height, width = struct.unpack_from(">HH", data, at + 5)
            if (width, height) != (WIRE_WIDTH_PX, WIRE_HEIGHT_PX):
                raise DamagedFrame(f"a JPEG of {width}x{height} instead of {WIRE_WIDTH_PX}x{WIRE_HEIGHT_PX}")
            has_size = True
        at += 2 + length
        if marker == 0xDA:
            break
    end = data.rfind(b"\xff\xd9", at)
    if not has_size or end < 0 or len(data) - end - 2 > PADDING_MAX_BYTES or data[end + 2 :].strip(b"\0"):
        raise DamagedFrame(f"a JPEG of {len(data)} bytes without its end")


def _to_portrait(landscape: Image) -> Image:
    return np.asarray(cv2.rotate(landscape, cv2.ROTATE_90_COUNTERCLOCKWISE), np.uint8)


class JpegDecoder:
    """Decodes one frame at a time in the loop's thread pool; a newer frame replaces the one that waits."""

    def __init__(self, stream: FrameStream) -> None:
        self._stream = stream
        self._waiting: tuple[RawFrame, float] | None = None
        self._busy = False

    def offer(self, frame: RawFrame, captured_at_s: float) -> None:
        """Decode a frame and put it into the stream, unless a newer one arrives before it is started."""
        self._waiting = (frame, captured_at_s)
        if not self._busy:
            self._start_next()

    def _start_next(self) -> None:
        if self._waiting is None:
            return
        (frame, captured_at_s), self._waiting = self._waiting, None
        self._busy = True
        decoding = asyncio.get_running_loop().run_in_executor(None, _image_or_damage, frame.data)
        decoding.add_done_callback(lambda done: self._on_done(done, frame, captured_at_s))

    def _on_done(self, done: asyncio.Future[Image | str], frame: RawFrame, captured_at_s: float) -> None:
        self._busy = False
        if done.cancelled():
            return
        result = done.result()
        if isinstance(result, str):
            self._stream.damaged(result)
        else:
            self._stream.put(result, captured_at_s, frame.sequence)
        self._start_next()


def _image_or_damage(data: bytes) -> Image | str:
    try:
        return decode_jpeg(data)
    except DamagedFrame as damage:
        return str(damage)
