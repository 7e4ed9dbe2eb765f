"""Images of the external camera that films the markers: live, or from a video, a folder of images, or a recording."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import TracebackType
from typing import Self

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.errors import InputError
from slipguard.evaluation.camera_calibration import Intrinsics
from slipguard.evaluation.lift_recording import read_lift
from slipguard.evaluation.markers import MarkerCorners, MarkerDetector
from slipguard.recording.ring import SUFFIX
from slipguard.tools.image_files import IMAGE_ENDINGS, STILL_IMAGES_FPS, read_bgr, read_video

TimedFrame = tuple[float, NDArray[np.uint8]]


class ExternalCamera:
    """A live camera that OpenCV opens, read in its own thread; the newest image wins. Raises InputError."""

    def __init__(self, source: str, intrinsics: Intrinsics) -> None:
        self._capture = cv2.VideoCapture(int(source)) if source.isdigit() else cv2.VideoCapture(source)
        self._capture.set(cv2.CAP_PROP_FRAME_WIDTH, intrinsics.width_px)
        self._capture.set(cv2.CAP_PROP_FRAME_HEIGHT, intrinsics.height_px)
        good, image = self._capture.read()
        if not good:
            self._capture.release()
            raise InputError(f"--camera {source}: no image; list the cameras with `v4l2-ctl --list-devices`")
        intrinsics.check_size(image.shape[1], image.shape[0], f"--camera {source}")
        self._receiver: Callable[[NDArray[np.uint8]], None] | None = None
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._read, name="external camera", daemon=True)
        self.lost = False

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stopping.set()
        self._thread.join(2.0)
        self._capture.release()

    def send_to(self, receiver: Callable[[NDArray[np.uint8]], None] | None) -> None:
        """Call `receiver` in the camera's thread with every image from now on; None stops this."""
        self._receiver = receiver

    def _read(self) -> None:
        while not self._stopping.is_set():
            good, image = self._capture.read()
            receiver = self._receiver
            if not good:
                self.lost = True
                return
            if receiver is not None:
                receiver(np.asarray(image, np.uint8))


def timed_frames(path: Path) -> Iterator[TimedFrame]:
    """Yield time in seconds and image (h, w, 3) uint8 BGR, in order. Raises InputError."""
    if path.is_dir():
        files = sorted(file for file in path.iterdir() if file.suffix.lower() in IMAGE_ENDINGS)
        if not files:
            raise InputError(f"{path}: no images in this folder")
        for number, file in enumerate(files):
            yield number / STILL_IMAGES_FPS, read_bgr(file)
    elif path.suffix.lower() == SUFFIX:
        for one in read_lift(path).camera:
            yield one.time_s, one.image.pixels()
    elif path.suffix.lower() in IMAGE_ENDINGS:
        yield 0.0, read_bgr(path)
    else:
        yield from read_video(path)


def markers_in(path: Path, intrinsics: Intrinsics, start_s: float = 0.0) -> Iterator[MarkerCorners]:
    """Yield the markers of every image, times relative to `start_s`.

    Raises InputError also if images and intrinsics differ in size.
    """
    detector = MarkerDetector()
    for time_s, image in timed_frames(path):
        intrinsics.check_size(image.shape[1], image.shape[0], str(path))
        yield detector.detect(image, start_s + time_s)
