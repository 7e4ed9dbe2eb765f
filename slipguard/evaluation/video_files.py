"""Pictures of an external camera from files: a film, a folder of images, or a lift's recording."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.datasets.mask_scores import read_bgr
from slipguard.errors import InputError
from slipguard.evaluation.intrinsics import Intrinsics
from slipguard.evaluation.lift_data import read_lift
from slipguard.evaluation.marker_detector import MarkerCorners, MarkerDetector
from slipguard.recording.ring import SUFFIX

IMAGES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
FILMS = (".mp4", ".avi", ".mkv", ".mov", ".m4v", ".webm")
IMAGE_FPS = 30.0
"""Images of a folder count as taken at this rate: they carry no time."""
TimedFrame = tuple[float, NDArray[np.uint8]]


def timed_frames(path: Path) -> Iterator[TimedFrame]:
    """Time in seconds and picture (h, w, 3) uint8 BGR, in order. Raises InputError in one line."""
    if path.is_dir():
        files = sorted(file for file in path.iterdir() if file.suffix.lower() in IMAGES)
        if not files:
            raise InputError(f"{path}: no images in this folder")
        for number, file in enumerate(files):
            yield number / IMAGE_FPS, read_bgr(file)
    elif path.suffix.lower() == SUFFIX:
        for one in read_lift(path).camera:
            yield one.time_s, one.picture.pixels()
    elif path.suffix.lower() in IMAGES:
        yield 0.0, read_bgr(path)
    else:
        yield from _film(path)


def _film(path: Path) -> Iterator[TimedFrame]:
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # what is wrong with a film is said here, in one line
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    film = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    try:
        if not film.isOpened():
            raise InputError(f"{path}: no film that can be read; is it cut off, or not a video?")
        fps = film.get(cv2.CAP_PROP_FPS)
        expected = int(film.get(cv2.CAP_PROP_FRAME_COUNT))
        count, last_s = 0, -1.0
        while True:
            good, picture = film.read()
            if not good:
                break
            at_s = 1e-3 * film.get(cv2.CAP_PROP_POS_MSEC)
            if at_s <= last_s:  # some containers carry no times
                at_s = last_s + 1.0 / (fps if fps > 0.0 else IMAGE_FPS)
            last_s = at_s
            count += 1
            yield at_s, np.asarray(picture, np.uint8)
        if count == 0:
            raise InputError(f"{path}: no picture can be read from it; it is cut off or empty")
        if expected > 0 and count < 0.9 * expected:
            raise InputError(f"{path}: ends after {count} of {expected} pictures; it is cut off")
    finally:
        film.release()


def markers_in(path: Path, intrinsics: Intrinsics, start_s: float = 0.0) -> Iterator[MarkerCorners]:
    """Both markers in every picture, times counted from `start_s`.

    Raises InputError also where pictures and intrinsics differ in size.
    """
    detector = MarkerDetector()
    for time_s, picture in timed_frames(path):
        intrinsics.check_size(picture.shape[1], picture.shape[0], str(path))
        yield detector.look(picture, start_s + time_s)
