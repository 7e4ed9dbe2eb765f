"""The external camera that films the markers on a real cell."""

from __future__ import annotations

import threading
from collections.abc import Callable
from types import TracebackType
from typing import Self

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.errors import InputError
from slipguard.evaluation.intrinsics import Intrinsics


class ExternalCamera:
    """Any camera OpenCV opens, read in a thread of its own; the newest picture wins. Raises InputError."""

    def __init__(self, source: str, intrinsics: Intrinsics) -> None:
        self._capture = cv2.VideoCapture(int(source)) if source.isdigit() else cv2.VideoCapture(source)
        self._capture.set(cv2.CAP_PROP_FRAME_WIDTH, intrinsics.width_px)
        self._capture.set(cv2.CAP_PROP_FRAME_HEIGHT, intrinsics.height_px)
        good, picture = self._capture.read()
        if not good:
            self._capture.release()
            raise InputError(f"--camera {source}: gives no picture; `v4l2-ctl --list-devices` names what there is")
        intrinsics.check_size(picture.shape[1], picture.shape[0], f"--camera {source}")
        self._taker: Callable[[NDArray[np.uint8]], None] | None = None
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._read, name="external camera", daemon=True)
        self.lost = False

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ending.set()
        self._thread.join(2.0)
        self._capture.release()

    def give_to(self, taker: Callable[[NDArray[np.uint8]], None] | None) -> None:
        """Call `taker` in the camera's thread with every picture from now on."""
        self._taker = taker

    def _read(self) -> None:
        while not self._ending.is_set():
            good, picture = self._capture.read()
            taker = self._taker
            if not good:
                self.lost = True
                return
            if taker is not None:
                taker(np.asarray(picture, np.uint8))
