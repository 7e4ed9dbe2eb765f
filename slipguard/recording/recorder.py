"""Writes the ring of recordings in a thread of its own, from values handed over by the loop.

Handing over never waits: a recorder that falls behind leaves pictures out, then everything, and counts it. A disk that
takes no more, or any other trouble, ends the recording with one line, and never the guard; it is tried again after a
while. The guard needs room on the disk first: the ring gives back what is missing, and then nothing is recorded.
"""

from __future__ import annotations

import contextlib
import errno
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import BinaryIO, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.control.step import ControlState
from slipguard.perception.pipeline import resize_mask_to_frame
from slipguard.recording import messages as m
from slipguard.recording.retention import Retention
from slipguard.recording.ring import NoRoom, Ring
from slipguard.recording.writer import RecordingClock, RecordingFile, RecordingHeader, open_new
from slipguard.thread_priority import set_worker_priority

BACKLOG_MAX = 2000
"""Values waiting for the disk. Pictures are left out from a quarter of it on: 250 of them are 60 MB."""
WAIT_S = 0.05
"""The thread looks so often for what waits. Woken for each value it would fight with the loop for the interpreter."""
TRY_AGAIN_S = 60.0
SETTLE_S = 1.0
"""A new no-contact image begins a new file, once the other finger has had the time to get its own."""
DISK_FULL = (errno.ENOSPC, errno.EDQUOT)


@dataclass(frozen=True, slots=True)
class RecorderSettings:
    """segment_s: length of one file. keep_before_s, keep_after_s: what is kept around an event."""

    image: Literal["jpeg", "png", "none"] = "jpeg"
    jpeg_quality: int = 90
    segment_s: float = 20.0
    keep_before_s: float = 20.0
    keep_after_s: float = 20.0


@dataclass(frozen=True, slots=True, eq=False)
class RecordedFrame:
    """A judged frame of one finger. image: (320, 240, 3) uint8; mask: (h, w) uint8, 0 or 1, of any size.

    What is None was left out.
    """

    finger: str
    at_s: float
    judged: m.FrameRecord
    image: NDArray[np.uint8] | None = None
    mask: NDArray[np.uint8] | None = None


@dataclass(frozen=True, slots=True)
class RecordedCycle:
    """One turn of the loop. memory: the law's, before it. keep: this is worth keeping."""

    tick: m.CycleRecord
    memory: ControlState
    keep: bool = False


@dataclass(frozen=True, slots=True)
class RecordedMessage:
    """One line of the log."""

    at_s: float
    text: str
    error: bool = False


class Recorder:
    """A thread that writes what it is handed. clock, header: called in that thread for each new file.

    on_trouble: told, in that thread, in one line, that recording has stopped or goes on again.
    """

    def __init__(
        self,
        ring: Ring,
        settings: RecorderSettings,
        clock: Callable[[], RecordingClock],
        header: Callable[[], RecordingHeader],
        on_trouble: Callable[[str], None],
        opener: Callable[[Path], BinaryIO] = open_new,
    ) -> None:
        self.left_out = 0
        """Values that found no room."""
        self.stopped: str | None = None
        """Why nothing is recorded at present."""
        self.stops = 0
        """How often the recording stopped."""
        self.path: Path | None = None
        self._ring, self._settings, self._clock, self._header = ring, settings, clock, header
        self._on_trouble, self._opener = on_trouble, opener
        self._waiting: deque[RecordedFrame | RecordedCycle | RecordedMessage] = deque()
        self._ending = threading.Event()
        self._file: RecordingFile | None = None
        self._began_s = self._last_s = 0.0
        self._renew_s = float("inf")
        self._keeping = Retention(ring, settings.keep_before_s, settings.keep_after_s)
        self._full_bytes = 0
        self._try_again_at = 0.0
        self._no_room = False
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)

    @property
    def takes_pictures(self) -> bool:
        """Whether pictures are recorded at all."""
        return self._settings.image != "none"

    @property
    def backlog(self) -> int:
        """Values that wait to be written."""
        return len(self._waiting)

    @property
    def dead(self) -> bool:
        """Whether its thread was started and has ended; then nothing is recorded any more."""
        return self._thread.ident is not None and not self._thread.is_alive()

    def start(self) -> None:
        """Begin; the first file is opened with the first turn of the loop."""
        self._thread.start()

    def hand(self, value: RecordedFrame | RecordedCycle | RecordedMessage) -> None:
        """Take a value over; never waits, and may leave it out. To be called from one thread only."""
        if isinstance(value, RecordedFrame) and value.image is not None and len(self._waiting) >= BACKLOG_MAX // 4:
            value = replace(value, image=None, mask=None)
            self.left_out += 1
        if len(self._waiting) >= BACKLOG_MAX:
            self.left_out += 1
            return
        self._waiting.append(value)

    def stop(self, timeout_s: float = 5.0) -> None:
        """Write what waits, close the file, end the thread."""
        self._ending.set()
        self._thread.join(timeout_s)

    def _run(self) -> None:
        set_worker_priority()
        self._guarded(self._ring.keep_unfinished)
        self._guarded(lambda: self._keeping.look_back(self._clock))
        ending = False
        while not ending:
            ending = self._ending.wait(WAIT_S)
            while self._waiting:
                self._take(self._waiting.popleft())
        self._guarded(self._finish)

    def _take(self, value: RecordedFrame | RecordedCycle | RecordedMessage) -> None:
        if isinstance(value, RecordedCycle) and value.keep:  # also while nothing is recorded
            self._guarded(lambda: self._keep_around(value.tick.now_s))
        if self.stopped is not None and time.monotonic() < self._try_again_at:
            return
        self._guarded(lambda: self._write(value))

    def _guarded(self, action: Callable[[], None]) -> None:
        """A disk that fails, and every other trouble, stops the recording, not the guard, and not the thread."""
        try:
            action()
        except OSError as error:
            if error.errno in DISK_FULL and self._gave_back():
                return  # the next turn begins a new file
            self._no_room = isinstance(error, NoRoom)
            self._stop_for_now(error.strerror or str(error), "make room or mend the disk, the guard goes on without")
        except Exception as error:
            self._stop_for_now(
                f"{type(error).__name__}: {' '.join(str(error).split())}",
                f"the guard goes on without, it is tried again every {TRY_AGAIN_S:g} s",
            )

    def _gave_back(self) -> bool:
        """End the present file as it is; whether the ring gave an older one back."""
        self._abandon()
        with contextlib.suppress(OSError):
            return self._ring.give_back(spare=self.path)
        return False

    def _stop_for_now(self, what: str, what_to_do: str) -> None:
        why = f"recording stopped: {what} ({self._ring.ring if self._file is None else self._file.path})"
        self._abandon()
        first = self.stopped is None
        self.stopped, self._try_again_at = why, time.monotonic() + TRY_AGAIN_S
        if first:
            self.stops += 1
            self._on_trouble(f"{why}; {what_to_do}")

    def _abandon(self) -> None:
        """End the present file without another byte; if it is to be kept it is, for a move needs no room."""
        file, self._file = self._file, None
        if file is not None:
            with contextlib.suppress(OSError):
                file.abandon()
            self._keeping.ended(file.path, self._last_s)
        with contextlib.suppress(OSError):
            self._keeping.move()

    def _write(self, value: RecordedFrame | RecordedCycle | RecordedMessage) -> None:
        if isinstance(value, RecordedCycle):
            self._cycle(value)
        elif self._file is None:
            return  # a file begins with the law's memory, so with a turn
        elif isinstance(value, RecordedFrame):
            self._frame(self._file, value)
        else:
            self._file.log(value.at_s, "error" if value.error else "info", value.text)

    def _cycle(self, cycle: RecordedCycle) -> None:
        now_s = cycle.tick.now_s
        if self._file is not None:
            self._see_that_there_is_room()
            if (
                now_s >= min(self._renew_s, self._began_s + self._settings.segment_s)
                or self._file.size_bytes >= self._full_bytes
            ):
                self._finish()
        file = self._file or self._begin(cycle.memory, now_s)
        self._last_s = now_s
        file.tick(cycle.tick)

    def _see_that_there_is_room(self) -> None:
        try:
            self._ring.make_room(self.path)
        except NoRoom:
            self._finish()  # whole, there is room for its index
            raise

    def _frame(self, file: RecordingFile, frame: RecordedFrame) -> None:
        if frame.judged.new_pipeline:
            self._renew_s = frame.at_s + SETTLE_S  # the file's no-contact images are those of its beginning
        write_frame(file, frame, self._settings)

    def _begin(self, memory: ControlState, now_s: float) -> RecordingFile:
        clock = self._clock()  # anew: a computer learns the right time some while after its start
        path = self._ring.new(clock.ns(now_s))
        self._ring.make_room(reserves=2 if self._no_room else 1)  # no stop a moment after every beginning
        self._full_bytes = self._ring.file_bytes()
        self._file = RecordingFile(path, clock, self._header(), memory, now_s, self._opener)
        self.path, self._no_room = path, False
        self._began_s, self._last_s, self._renew_s = now_s, now_s, float("inf")
        self._keeping.begun(now_s)
        self._ring.tidy(path)
        if self.stopped is not None:
            self.stopped = None
            self._on_trouble("recording again")
        return self._file

    def _finish(self) -> None:
        """Close the present file, and move it if it is kept."""
        file, self._file = self._file, None
        if file is None:
            return
        try:
            file.close()
        finally:
            self._keeping.ended(file.path, self._last_s)
            self._keeping.move()

    def _keep_around(self, now_s: float) -> None:
        self._keeping.event(now_s)
        self._ring.tidy(self.path)


def write_frame(file: RecordingFile, frame: RecordedFrame, settings: RecorderSettings) -> None:
    """One judged frame: its picture, its mask, and what was made of it. May raise OSError."""
    frame_s = frame.judged.captured_at_s
    if frame.image is not None and settings.image != "none":
        file.image(frame.finger, frame_s, _encoded(frame.image, settings), settings.image)
    if frame.mask is not None:
        mask = resize_mask_to_frame(frame.mask) * np.uint8(255)
        file.mask(frame.finger, frame_s, cv2.imencode(".png", mask)[1].tobytes())
    file.judged(frame.finger, frame.at_s, frame.judged)


def _encoded(image: NDArray[np.uint8], settings: RecorderSettings) -> bytes:
    if settings.image == "png":
        return cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes()
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, settings.jpeg_quality])[1].tobytes()
