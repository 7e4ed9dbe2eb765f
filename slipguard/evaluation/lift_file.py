"""One lift, one MCAP file: what the daemon records, the external camera, and a world's truth if it has one."""

from __future__ import annotations

import asyncio
import contextlib
import json
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Self

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.daemon.loop.service import Service
from slipguard.daemon.store.recording import RecordingObserver, header
from slipguard.errors import SlipguardError
from slipguard.evaluation.intrinsics import Intrinsics
from slipguard.evaluation.protocol import LiftProtocol, PlannedLift
from slipguard.recording import messages as m
from slipguard.recording.recorder import RecordedCycle, RecordedFrame, RecordedMessage, RecorderSettings, write_frame
from slipguard.recording.writer import RecordingClock, RecordingFile, RecordingHeader

CAMERA_QUALITY = 88
FINGERS = RecorderSettings("jpeg", 95)
PART = ".part"
LIFT_ATTACHMENT = "lift.json"
INTRINSICS_ATTACHMENT = "intrinsics.json"


class LiftRecorder:
    """Records a service into `path` while it is entered; the file has its name only once it is whole.

    What it is handed is written on the spot: an experiment may cost some milliseconds more than the daemon. A disk that
    takes no more never disturbs who hands something over, for an object hangs in the air then: nothing more is written,
    and leaving raises SlipguardError.
    """

    def __init__(
        self,
        path: Path,
        service: Service,
        protocol: LiftProtocol,
        lift: PlannedLift,
        intrinsics: Intrinsics,
        true_lag_s: float | None,
    ) -> None:
        self._path, self._service = path, service
        about = {
            "protocol": protocol.name,
            "object": lift.thing.name,
            "seen": lift.thing.seen,
            "hard": lift.thing.hard,
            "repeat": lift.repeat,
            "number": lift.number,
            "guard": protocol.guard,
            "marker_side_mm": protocol.marker_side_mm,
            "camera_side": protocol.camera_side,
            "camera_lag_s": true_lag_s,
        }
        self._attachments = {
            LIFT_ATTACHMENT: json.dumps(about, indent=1).encode(),
            INTRINSICS_ATTACHMENT: intrinsics.model_dump_json(indent=1).encode(),
        }
        self._file: RecordingFile | None = None
        self._broken: OSError | None = None
        self._part = path.with_name(path.name + PART)
        self._clock = RecordingClock(time.time_ns(), asyncio.get_running_loop().time())
        self._watcher = RecordingObserver(self)
        self._judges = {
            name: (lambda processed, name=name: self._watcher.judged(name, processed)) for name in service.fingers
        }

    takes_pictures = True

    def __enter__(self) -> Self:
        with contextlib.suppress(OSError):
            self._part.unlink()
        for name, finger in self._service.fingers.items():
            finger.observers.append(self._judges[name])
        self._service.observers.append(self._watcher.decided)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for name, finger in self._service.fingers.items():
            finger.observers.remove(self._judges[name])
        self._service.observers.remove(self._watcher.decided)
        file, self._file = self._file, None  # a camera's thread may still hand over a picture
        if error is None and self._broken is None and file is not None:
            try:
                file.close()
                self._part.replace(self._path)
                return
            except OSError as broken:
                self._broken = broken
        with contextlib.suppress(OSError):
            if file is not None:
                file.abandon()
            self._part.unlink(missing_ok=True)
        if error is None and self._broken is not None:
            why = self._broken.strerror or self._broken
            raise SlipguardError(f"{self._path}: not recorded ({why}); make room, then start again")

    def hand(self, value: RecordedFrame | RecordedCycle | RecordedMessage) -> None:
        """Write what the daemon tells."""
        if isinstance(value, RecordedCycle):
            self._write(lambda file: file.tick(value.tick), first=value)
        elif isinstance(value, RecordedFrame):
            self._write(lambda file: write_frame(file, value, FINGERS))

    def camera(self, at_s: float, encoded: bytes) -> None:
        """A picture of the external camera, as JPEG; at_s: its time stamp on the loop's clock."""
        self._write(lambda file: file.image(m.CAMERA, at_s, encoded, "jpeg"))

    def truth(self, truth: m.TruthRecord) -> None:
        """What a simulated world knows."""
        self._write(lambda file: file.truth(truth))

    def true_mask(self, finger: str, at_s: float, mask: NDArray[np.uint8]) -> None:
        """(320, 240) 0 or 1: what a person would outline at that moment."""
        png = cv2.imencode(".png", mask * np.uint8(255))[1].tobytes()
        self._write(lambda file: file.true_mask(finger, at_s, png))

    def _write(self, what: Callable[[RecordingFile], None], first: RecordedCycle | None = None) -> None:
        """Nothing before the file has begun, which the first turn of the loop does, nor after its disk has failed."""
        if self._broken is not None:
            return
        try:
            if self._file is None and first is not None:
                self._file = self._begin(first)
            if self._file is not None:
                what(self._file)
        except OSError as error:
            self._broken = error

    def _begin(self, first: RecordedCycle) -> RecordingFile:
        plain = header(self._service)
        about = RecordingHeader(plain.facts, {**plain.attachments, **self._attachments})
        return RecordingFile(self._part, self._clock, about, first.memory, first.tick.now_s)


def encoded(image: NDArray[np.uint8]) -> bytes:
    """A camera picture as JPEG."""
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, CAMERA_QUALITY])[1].tobytes()
