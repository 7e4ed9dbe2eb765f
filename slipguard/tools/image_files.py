"""Gel frames from files: images, folders and videos, each checked before anything is measured on it."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.devices import FRAME_HEIGHT_PX, FRAME_WIDTH_PX
from slipguard.errors import InputError
from slipguard.tools.image_decoding import decode_file

IMAGE_ENDINGS = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp"})
VIDEO_ENDINGS = frozenset({".mp4", ".avi", ".mkv", ".mov", ".webm", ".m4v", ".mjpeg", ".mjpg"})
STILL_IMAGES_FPS = 30.0
"""Image files have no time stamps; they count as one recording at the usual rate of a DIGIT."""
VIDEO_PIXELS_MAX = 2**23
"""4K has 8.3 million. A decoder keeps several frames."""
DARK_LEVEL, BRIGHT_LEVEL = 8, 247


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
    """Return the image and video files of `paths` in order; a folder stands for its images, sorted by name.

    Raises:
        InputError: If a path does not exist, a folder has no images, or a file is neither image nor video.
    """
    out: list[Path] = []
    for path in paths:
        if path.is_dir():
            inside = sorted(file for file in path.iterdir() if file.suffix.lower() in IMAGE_ENDINGS)
            if not inside:
                raise InputError(f"{path}: no image in this folder. Supported: {_endings(IMAGE_ENDINGS)}")
            out += inside
        elif not path.exists():
            raise InputError(f"{path}: no such file or folder")
        elif path.suffix.lower() in IMAGE_ENDINGS | VIDEO_ENDINGS:
            out.append(path)
        else:
            known = _endings(IMAGE_ENDINGS | VIDEO_ENDINGS)
            raise InputError(f"{path}: unknown file type. Supported: {known}")
    return out


def read_frames(files: list[Path]) -> Iterator[FileFrame]:
    """Yield the frames of the files in order, as one recording. Raises `InputError` at the first unusable file."""
    at_s = 0.0
    for file in files:
        if file.suffix.lower() in VIDEO_ENDINGS:
            start_s = at_s
            for number, (time_s, image) in enumerate(read_video(file)):
                name, at_s = f"{file.stem}-{number:06d}", start_s + time_s
                yield _checked_frame(image, f"{file}, frame {number}", name, name, at_s)
        else:
            yield _checked_frame(read_image(file), str(file), file.name, file.stem, at_s)
        at_s += 1.0 / STILL_IMAGES_FPS


def read_gel_image(path: Path) -> NDArray[np.uint8]:
    """Return a gel image as (320, 240, 3) uint8 BGR. Raises `InputError` if it is unusable."""
    return _checked_frame(read_image(path), str(path), path.name, path.stem, 0.0).image


def read_image(path: Path) -> NDArray[np.uint8]:
    """Return the pixels of an 8-bit color image file, BGR. Raises `InputError` for a damaged, gray or 16-bit one."""
    pixels = decode_file(path, cv2.IMREAD_UNCHANGED)
    if pixels.dtype != np.uint8:
        raise InputError(f"{path}: {8 * pixels.dtype.itemsize} bits per channel. 8-bit color is needed")
    if pixels.ndim == 2 or pixels.shape[2] < 3:
        raise InputError(f"{path}: gray image. Color is needed: it shows the slope of the gel")
    if pixels.shape[2] == 4:
        if int(pixels[..., 3].min()) < 255:
            raise InputError(f"{path}: partly transparent. An opaque color image is needed")
        pixels = pixels[..., :3]
    return np.ascontiguousarray(pixels, np.uint8)


def read_bgr(path: Path) -> NDArray[np.uint8]:
    """Return any image, such as a mask, as (H, W, 3) uint8 BGR, without `read_image`'s checks. Raises InputError."""
    return np.asarray(decode_file(path, cv2.IMREAD_COLOR), np.uint8)


def _checked_frame(image: NDArray[np.uint8], what: str, name: str, stem: str, at_s: float) -> FileFrame:
    height, width = image.shape[:2]
    _check_size(width, height, what)
    if int(image.max()) < DARK_LEVEL:
        raise InputError(f"{what}: all black. Check the LEDs and the exposure of the sensor")
    if int(image.min()) > BRIGHT_LEVEL:
        raise InputError(f"{what}: all white. Check the LEDs and the exposure of the sensor")
    if np.array_equal(image[..., 0], image[..., 1]) and np.array_equal(image[..., 1], image[..., 2]):
        raise InputError(f"{what}: gray image: all channels are equal. Color is needed: it shows the slope of the gel")
    if (width, height) != (FRAME_WIDTH_PX, FRAME_HEIGHT_PX):
        size = (FRAME_WIDTH_PX, FRAME_HEIGHT_PX)
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
    image.flags.writeable = False
    return FileFrame(name, stem, image, at_s, width, height)


def _check_size(width: int, height: int, what: str) -> None:
    wanted = f"{FRAME_WIDTH_PX}x{FRAME_HEIGHT_PX} (width x height) or a larger image of the same 3:4 shape"
    if width * FRAME_WIDTH_PX == height * FRAME_HEIGHT_PX:
        raise InputError(
            f"{what}: {width}x{height} is rotated by 90 degrees, as the camera streams it. {wanted} is "
            "needed. Transpose the image, then flip it vertically, as digit-interface does"
        )
    if width * FRAME_HEIGHT_PX != height * FRAME_WIDTH_PX or width < FRAME_WIDTH_PX:
        raise InputError(f"{what}: {width}x{height}. {wanted} is needed")


def read_video(path: Path) -> Iterator[tuple[float, NDArray[np.uint8]]]:
    """Yield time in seconds and image, BGR, of every frame. Raises `InputError` for a damaged or truncated file."""
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # ffmpeg's messages would repeat ours
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    if path.stat().st_size == 0:
        raise InputError(f"{path}: the file is empty. Give an intact video file")
    previous = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    video = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    try:
        if not video.isOpened():
            raise InputError(f"{path}: not a decodable video. Give an MP4, AVI or MKV file")
        size = (int(video.get(cv2.CAP_PROP_FRAME_WIDTH)), int(video.get(cv2.CAP_PROP_FRAME_HEIGHT)))
        if size[0] * size[1] > VIDEO_PIXELS_MAX:
            raise InputError(f"{path}: {size[0]}x{size[1]} pixels, more than {VIDEO_PIXELS_MAX}. Give a smaller video")
        fps = video.get(cv2.CAP_PROP_FPS)
        step_s = 1.0 / fps if 1.0 <= fps <= 1000.0 else 1.0 / STILL_IMAGES_FPS
        announced = int(video.get(cv2.CAP_PROP_FRAME_COUNT))
        count, last_s = 0, -step_s
        while True:
            there, image = video.read()
            if not there:
                break
            if image.shape[1::-1] != size:
                raise InputError(f"{path}: frame {count} has another size than the first. Give an intact video file")
            at_s = 1e-3 * video.get(cv2.CAP_PROP_POS_MSEC)
            last_s = at_s if at_s > last_s else last_s + step_s  # some containers carry no times
            count += 1
            yield last_s, np.asarray(image, np.uint8)
    finally:
        video.release()
        cv2.utils.logging.setLogLevel(previous)
    if count == 0:
        raise InputError(f"{path}: the video has no frames")
    if announced > count + 1:  # containers are often off by one
        raise InputError(f"{path}: ends after {count} of {announced} frames. Give an intact video file")


def _endings(endings: frozenset[str]) -> str:
    return ", ".join(sorted(endings))
