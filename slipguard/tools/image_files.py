"""Gel frames from files: images, folders and videos, each checked before anything is measured on it."""

from __future__ import annotations

import os
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.devices import FRAME_HEIGHT_PX, FRAME_WIDTH_PX
from slipguard.errors import InputError

IMAGE_ENDINGS = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp"})
VIDEO_ENDINGS = frozenset({".mp4", ".avi", ".mkv", ".mov", ".webm", ".m4v", ".mjpeg", ".mjpg"})
STILL_IMAGES_FPS = 30.0
"""Stills carry no time; they count as one recording at the DIGIT's usual rate."""
LARGEST_SIDE_PX = 8192
DARK_LEVEL, BRIGHT_LEVEL = 8, 247
_PNG_START = b"\x89PNG\r\n\x1a\n"
_JPEG_START, _JPEG_END = b"\xff\xd8\xff", b"\xff\xd9"


@dataclass(frozen=True, slots=True, eq=False)
class FileFrame:
    """One frame of a recording. image: (320, 240, 3) uint8 BGR, read-only; width_px, height_px: as in the file."""

    name: str
    stem: str
    image: NDArray[np.uint8]
    captured_at_s: float
    width_px: int
    height_px: int


def find_image_files(paths: list[Path]) -> list[Path]:
    """The image and video files that `paths` stand for, in order; a folder is its images, sorted by name.

    Raises `InputError` for a path that is not there, a folder without images, or an ending that is neither.
    """
    out: list[Path] = []
    for path in paths:
        if path.is_dir():
            inside = sorted(file for file in path.iterdir() if file.suffix.lower() in IMAGE_ENDINGS)
            if not inside:
                raise InputError(f"{path}: no image in this folder; {_endings(IMAGE_ENDINGS)} are looked for")
            out += inside
        elif not path.exists():
            raise InputError(f"{path}: no such file or folder")
        elif path.suffix.lower() in IMAGE_ENDINGS | VIDEO_ENDINGS:
            out.append(path)
        else:
            known = _endings(IMAGE_ENDINGS | VIDEO_ENDINGS)
            raise InputError(f"{path}: neither an image nor a video by its ending; {known} are read")
    return out


def read_frames(files: list[Path]) -> Iterator[FileFrame]:
    """Every frame of the files in order, as one recording. Raises `InputError` naming the file at the first bad one."""
    at_s = 0.0
    for file in files:
        if file.suffix.lower() in VIDEO_ENDINGS:
            for number, (image, step_s) in enumerate(_video(file)):
                name = f"{file.stem}-{number:06d}"
                yield _still(image, f"{file}, frame {number}", name, name, at_s)
                at_s += step_s
        else:
            yield _still(read_image(file), str(file), file.name, file.stem, at_s)
            at_s += 1.0 / STILL_IMAGES_FPS


def read_gel_image(path: Path) -> NDArray[np.uint8]:
    """One gel image as (320, 240, 3) uint8 BGR. Raises `InputError` naming the file."""
    return _still(read_image(path), str(path), path.name, path.stem, 0.0).image


def read_image(path: Path) -> NDArray[np.uint8]:
    """The pixels of an 8-bit colour image file, BGR. Raises `InputError` for a damaged, grey or 16-bit one."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    wrong = damage(data)
    if wrong:
        raise InputError(f"{path}: {wrong}; give a whole image file")
    previous = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        pixels = None
    finally:
        cv2.utils.logging.setLogLevel(previous)
    if pixels is None:
        raise InputError(f"{path}: no image can be decoded from it; give an 8-bit colour PNG or JPEG")
    if pixels.dtype != np.uint8:
        raise InputError(f"{path}: {8 * pixels.dtype.itemsize} bits a channel; 8-bit colour is needed")
    if pixels.ndim == 2 or pixels.shape[2] < 3:
        raise InputError(f"{path}: grey; colour is needed, it carries the slope of the gel")
    if pixels.shape[2] == 4:
        if int(pixels[..., 3].min()) < 255:
            raise InputError(f"{path}: partly transparent; an opaque colour image is needed")
        pixels = pixels[..., :3]
    return np.ascontiguousarray(pixels, np.uint8)


def _still(image: NDArray[np.uint8], what: str, name: str, stem: str, at_s: float) -> FileFrame:
    height, width = image.shape[:2]
    _check_size(width, height, what)
    if int(image.max()) < DARK_LEVEL:
        raise InputError(f"{what}: all black; check the LEDs and the exposure of the sensor")
    if int(image.min()) > BRIGHT_LEVEL:
        raise InputError(f"{what}: all white; check the LEDs and the exposure of the sensor")
    if np.array_equal(image[..., 0], image[..., 1]) and np.array_equal(image[..., 1], image[..., 2]):
        raise InputError(f"{what}: grey in all channels; colour is needed, it carries the slope of the gel")
    if (width, height) != (FRAME_WIDTH_PX, FRAME_HEIGHT_PX):
        size = (FRAME_WIDTH_PX, FRAME_HEIGHT_PX)
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
    image.flags.writeable = False
    return FileFrame(name, stem, image, at_s, width, height)


def _check_size(width: int, height: int, what: str) -> None:
    wanted = f"{FRAME_WIDTH_PX}x{FRAME_HEIGHT_PX} (width x height) or a larger picture of the same 3:4 shape"
    if width * FRAME_WIDTH_PX == height * FRAME_HEIGHT_PX:
        raise InputError(
            f"{what}: {width}x{height} lies on its side, as the camera streams it; {wanted} is needed: "
            "turn it upright first as digit-interface does (transpose, then flip top to bottom)"
        )
    if width * FRAME_HEIGHT_PX != height * FRAME_WIDTH_PX or width < FRAME_WIDTH_PX:
        raise InputError(f"{what}: {width}x{height}; {wanted} is needed")
    if height > LARGEST_SIDE_PX:
        raise InputError(f"{what}: {width}x{height}; at most {LARGEST_SIDE_PX} pixels high are read")


def _video(path: Path) -> Iterator[tuple[NDArray[np.uint8], float]]:
    """(image, seconds to the next one) for every frame of a video file."""
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # our one line says it; ffmpeg's many do not
    if path.stat().st_size == 0:
        raise InputError(f"{path}: the file is empty; give a whole video file")
    previous = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    capture = cv2.VideoCapture(str(path))
    try:
        if not capture.isOpened():
            raise InputError(f"{path}: no video can be decoded from it")
        fps = capture.get(cv2.CAP_PROP_FPS)
        step_s = 1.0 / fps if 1.0 <= fps <= 1000.0 else 1.0 / STILL_IMAGES_FPS
        announced = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
        count = 0
        while True:
            there, image = capture.read()
            if not there:
                break
            count += 1
            yield np.asarray(image, np.uint8), step_s
    finally:
        capture.release()
        cv2.utils.logging.setLogLevel(previous)
    if count == 0:
        raise InputError(f"{path}: a video without a frame")
    if announced > count + 1:  # containers are often off by one
        raise InputError(f"{path}: ends after {count} of {announced} frames; the file is cut short")


def damage(data: bytes) -> str | None:
    """What is wrong with the bytes of an image file, as far as its container tells; None if nothing."""
    if not data:
        return "the file is empty"
    if data.startswith(_PNG_START):
        return _png_damage(data)
    if data.startswith(_JPEG_START) and _JPEG_END not in data[-64:]:
        return "the JPEG is cut short"
    return None


def _png_damage(data: bytes) -> str | None:
    at = len(_PNG_START)
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
    return "the PNG is cut short"


def _endings(endings: frozenset[str]) -> str:
    return ", ".join(sorted(endings))
