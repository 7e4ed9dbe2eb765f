"""Decode image files from anywhere: damage is found, and memory is bounded before anything is decoded."""

from __future__ import annotations

import contextlib
import os
import struct
import threading
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard import IMAGE_PIXELS_MAX
from slipguard.errors import InputError
from slipguard.limited_read import read_limited

FILE_MAX_BYTES = 64 * 2**20
"""More than the largest image of 8 bits takes without compression."""
TIFF_GRAY_BITS_MAX = 16
"""Of a mask."""
_PNG, _JPEG = b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff"
_PNG_COLOR = (2, 6)
"""Color types RGB and RGBA."""
_TIFF = {b"II*\0": "<", b"MM\0*": ">"}
_JPEG_END = b"\xff\xd9"
_TIFF_BITS, _TIFF_TILES = 258, (322, 323)
_TIFF_SHORT = 3
_stderr_lock = threading.Lock()


def decode_file(path: Path, flags: int) -> NDArray[Any]:
    """Return the pixels of a PNG, JPEG, BMP, TIFF or WebP file, as OpenCV decodes it.

    Raises InputError for a damaged file, and for one of more than `IMAGE_PIXELS_MAX` pixels.

    Args:
        path: The file.
        flags: `cv2.IMREAD_...`.
    """
    if path.exists() and not path.is_file():  # a folder, or a device that never ends
        raise InputError(f"{path}: not an image file. Give an 8-bit color PNG or JPEG")
    try:
        data = read_limited(path, FILE_MAX_BYTES)
    except OSError as error:
        raise InputError(f"{path}: cannot read the file: {error.strerror}") from error
    found_damage = _damage(data)
    if found_damage:
        raise InputError(f"{path}: {found_damage}. Give an intact 8-bit image file")
    with _stderr_captured() as written:
        try:
            pixels = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
        except cv2.error as error:
            if "CV_IO_MAX_IMAGE" in str(error):
                raise InputError(f"{path}: more than {IMAGE_PIXELS_MAX} pixels. Give a smaller image") from None
            pixels = None
        messages = written()
    if pixels is None:
        raise InputError(f"{path}: not a decodable image. Give an 8-bit color PNG or JPEG")
    # libjpeg fills what is missing, and reports it on stderr only.
    if b"premature end" in messages.lower() or b"bad Huffman code" in messages:
        raise InputError(f"{path}: the JPEG is truncated or damaged. Give an intact 8-bit image file")
    return np.asarray(pixels)


def _damage(data: bytes) -> str | None:
    """Return the damage, or the cause of too much memory, that an image file's container reveals."""
    if not data:
        return "the file is empty"
    if data.startswith(_PNG):
        return _png_damage(data)
    if data.startswith(_JPEG):
        return None if _JPEG_END in data[-64:] else "the JPEG is truncated"
    if data[:4] in _TIFF:
        return _tiff_damage(data)
    if data.startswith(b"BM") or (data.startswith(b"RIFF") and data[8:12] == b"WEBP"):
        return None
    return "not a decodable image, neither PNG, JPEG, BMP, TIFF nor WebP"


def _png_damage(data: bytes) -> str | None:
    if len(data) > 25 and data[24] == 16 and data[25] in _PNG_COLOR:
        return "16 bits per channel"  # twice as much memory, for nothing
    at = len(_PNG)
    while at + 12 <= len(data):
        length = int.from_bytes(data[at : at + 4], "big")
        end = at + 12 + length
        if end > len(data):
            break
        kind = data[at + 4 : at + 8]
        if zlib.crc32(data[at + 4 : end - 4]) != int.from_bytes(data[end - 4 : end], "big"):
            return "the PNG is damaged (checksum)"
        if kind == b"IEND":
            return None
        at = end
    return "the PNG is truncated"


def _tiff_damage(data: bytes) -> str | None:
    """A tile may be larger than the image; a sample of 32 or 64 bits takes four times the memory."""
    order = _TIFF[data[:4]]
    try:
        (at,) = struct.unpack_from(f"{order}I", data, 4)
        (entries,) = struct.unpack_from(f"{order}H", data, at)
        for entry in range(at + 2, at + 2 + 12 * entries, 12):
            tag, kind, count = struct.unpack_from(f"{order}HHI", data, entry)
            if tag in _TIFF_TILES:
                return "a TIFF in tiles"
            if tag == _TIFF_BITS:
                where = entry + 8 if count <= 2 else struct.unpack_from(f"{order}I", data, entry + 8)[0]
                bits = max(struct.unpack_from(f"{order}{min(count, 8)}H", data, where), default=0)
                if kind != _TIFF_SHORT or bits > (TIFF_GRAY_BITS_MAX if count == 1 else 8):
                    return f"{bits} bits per channel"
    except struct.error:
        return "the TIFF is truncated"
    return None


@contextlib.contextmanager
def _stderr_captured() -> Iterator[Any]:
    """Keep what C libraries write to file descriptor 2; provides a function that returns it."""
    with _stderr_lock, open(os.memfd_create("decoder"), "w+b", buffering=0) as file:
        try:
            own = os.dup(2)
        except OSError:  # the process has no stderr
            own = None
        if own is not None:
            os.dup2(file.fileno(), 2)
        try:
            yield lambda: _content(file)
        finally:
            if own is not None:
                os.dup2(own, 2)
                os.close(own)


def _content(file: BinaryIO) -> bytes:
    file.seek(0)
    return file.read()
