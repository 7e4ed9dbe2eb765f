"""Writes the ring of recordings in a thread of its own.

Handing a value over never waits: a recorder that falls behind leaves out images, then everything, and counts it. A full
disk, or any other failure, stops the recording with one log line, never the guard; the recorder tries again later. If
the reserve of the disk is needed, the ring frees its oldest files first, and then nothing is recorded.
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

from slipguard.control.control_step import ControlState
from slipguard.perception.patch import resize_mask_to_frame
from slipguard.recording import messages as m
from slipguard.recording.ring import NoRoom, Retention, Ring
from slipguard.recording.writer import RecordingClock, RecordingFile, RecordingHeader, open_new
from slipguard.thread_priority import set_worker_priority

BACKLOG_MAX = 2000
"""Values that may wait for the disk. From a quarter of it on images are left out: 250 of them are 60 MB."""
WAIT_S = 0.05
"""The thread checks for values at this interval. Waking it for each value would disturb the loop."""
RETRY_S = 60.0
SETTLE_S = 1.0
"""A new background image begins a new file after this time, in which the other finger gets its own."""
DISK_FULL = (errno.ENOSPC, errno.EDQUOT)


@dataclass(frozen=True, slots=True)
class RecorderSettings:
    """segment_s: length of one file. keep_before_s, keep_after_s: time that is kept around an event."""

    image: Literal["jpeg", "png", "none"] = "jpeg"
    jpeg_quality: int = 90
    segment_s: float = 20.0
    keep_before_s: float = 20.0
    keep_after_s: float = 20.0


@dataclass(frozen=True, slots=True, eq=False)
class RecordedFrame:
    """A processed frame of one finger. image: (320, 240, 3) uint8; mask: (h, w) uint8, 0 or 1, of any size.

    image and mask are None if they are left out.
    """

    finger: str
    at_s: float
    record: m.FrameRecord
    image: NDArray[np.uint8] | None = None
    mask: NDArray[np.uint8] | None = None


@dataclass(frozen=True, slots=True)
class RecordedCycle:
    """One cycle of the loop. memory: the controller's state before it. keep: the files around it are to be kept."""

    record: m.CycleRecord
    memory: ControlState
    keep: bool = False


@dataclass(frozen=True, slots=True)
class RecordedMessage:
    """One message of the log."""

    at_s: float
    text: str
    error: bool = False


class Recorder:
    """A thread that writes the values it is given.

    Args:
        ring: The folder of the recordings.
        settings: What is recorded.
        clock: Returns the relation of the clocks for a new file; called in the thread.
        header: Returns the header of a new file; called in the thread.
        on_trouble: Receives one line when recording stops or continues; called in the thread.
        opener: Opens a new file, unbuffered.
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
        """Values that were left out because too many were waiting."""
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
        self._retention = Retention(ring, settings.keep_before_s, settings.keep_after_s)
        self._full_bytes = 0
        self._retry_at_s = 0.0
        self._no_room = False
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)

    @property
    def records_images(self) -> bool:
        return self._settings.image != "none"

    @property
    def backlog(self) -> int:
        """Number of values that wait to be written."""
        return len(self._waiting)

    @property
    def dead(self) -> bool:
        """Whether the thread was started and has ended."""
        return self._thread.ident is not None and not self._thread.is_alive()

    def start(self) -> None:
        """Start the thread; the first file is opened with the first cycle of the loop."""
        self._thread.start()

    def add(self, value: RecordedFrame | RecordedCycle | RecordedMessage) -> None:
        """Take a value; never waits, and may leave it out. To be called from one thread only."""
        if isinstance(value, RecordedFrame) and value.image is not None and len(self._waiting) >= BACKLOG_MAX // 4:
            value = replace(value, image=None, mask=None)
            self.left_out += 1
        if len(self._waiting) >= BACKLOG_MAX:
            self.left_out += 1
            return
        self._waiting.append(value)

    def stop(self, timeout_s: float = 5.0) -> None:
        """Write the waiting values, close the file, end the thread."""
        self._ending.set()
        self._thread.join(timeout_s)

    def _run(self) -> None:
        set_worker_priority()
        self._guarded(self._ring.keep_unfinished)
        self._guarded(lambda: self._retention.add_existing(self._clock))
        ending = False
        while not ending:
            ending = self._ending.wait(WAIT_S)
            while self._waiting:
                self._take(self._waiting.popleft())
        self._guarded(self._finish)

    def _take(self, value: RecordedFrame | RecordedCycle | RecordedMessage) -> None:
        if isinstance(value, RecordedCycle) and value.keep:  # also while nothing is recorded
            self._guarded(lambda: self._keep_around(value.record.now_s))
        if self.stopped is not None and time.monotonic() < self._retry_at_s:
            return
        self._guarded(lambda: self._write(value))

    def _guarded(self, action: Callable[[], None]) -> None:
        """Call `action`; a failure stops the recording, but neither the thread nor the guard."""
        try:
            action()
        except OSError as error:
            if error.errno in DISK_FULL and self._free_one_file():
                return  # the next cycle begins a new file
            self._no_room = isinstance(error, NoRoom)
            self._stop_for_now(error.strerror or str(error), "free space on the disk or repair it; the guard goes on")
        except Exception as error:
            self._stop_for_now(
                f"{type(error).__name__}: {' '.join(str(error).split())}",
                f"the guard goes on; recording is tried again every {RETRY_S:g} s",
            )

    def _free_one_file(self) -> bool:
        """End the current file as it is; return whether the ring could delete an older one."""
        self._abandon()
        with contextlib.suppress(OSError):
            return self._ring.delete_oldest(spare=self.path)
        return False

    def _stop_for_now(self, what: str, what_to_do: str) -> None:
        reason = f"recording stopped: {what} ({self._ring.ring if self._file is None else self._file.path})"
        self._abandon()
        first = self.stopped is None
        self.stopped, self._retry_at_s = reason, time.monotonic() + RETRY_S
        if first:
            self.stops += 1
            self._on_trouble(f"{reason}; {what_to_do}")

    def _abandon(self) -> None:
        """End the current file without writing; keep it if it is to be kept, because moving needs no space."""
        file, self._file = self._file, None
        if file is not None:
            with contextlib.suppress(OSError):
                file.abandon()
            self._retention.file_ended(file.path, self._last_s)
        with contextlib.suppress(OSError):
            self._retention.move()

    def _write(self, value: RecordedFrame | RecordedCycle | RecordedMessage) -> None:
        if isinstance(value, RecordedCycle):
            self._write_cycle(value)
        elif self._file is None:
            return  # a file begins with the controller's state, that is, with a cycle
        elif isinstance(value, RecordedFrame):
            if value.record.new_pipeline:
                self._renew_s = value.at_s + SETTLE_S  # the background images of a file are those of its beginning
            write_frame(self._file, value, self._settings)
        else:
            self._file.log(value.at_s, "error" if value.error else "info", value.text)

    def _write_cycle(self, cycle: RecordedCycle) -> None:
        now_s = cycle.record.now_s
        if self._file is not None:
            self._check_room()
            if (
                now_s >= min(self._renew_s, self._began_s + self._settings.segment_s)
                or self._file.size_bytes >= self._full_bytes
            ):
                self._finish()
        file = self._file or self._begin(cycle.memory, now_s)
        self._last_s = now_s
        file.cycle(cycle.record)

    def _check_room(self) -> None:
        try:
            self._ring.make_room(self.path)
        except NoRoom:
            self._finish()  # there is still room for its index
            raise

    def _begin(self, memory: ControlState, now_s: float) -> RecordingFile:
        clock = self._clock()  # for each file, because a computer gets the right time some time after its start
        path = self._ring.new(clock.ns(now_s))
        self._ring.make_room(reserves=2 if self._no_room else 1)  # so that it does not stop again at once
        self._full_bytes = self._ring.file_bytes()
        self._file = RecordingFile(path, clock, self._header(), memory, now_s, self._opener)
        self.path, self._no_room = path, False
        self._began_s, self._last_s, self._renew_s = now_s, now_s, float("inf")
        self._retention.file_began(now_s)
        self._ring.tidy(path)
        if self.stopped is not None:
            self.stopped = None
            self._on_trouble("recording again")
        return self._file

    def _finish(self) -> None:
        """Close the current file, and move it if it is to be kept."""
        file, self._file = self._file, None
        if file is None:
            return
        try:
            file.close()
        finally:
            self._retention.file_ended(file.path, self._last_s)
            self._retention.move()

    def _keep_around(self, now_s: float) -> None:
        self._retention.add_event(now_s)
        self._ring.tidy(self.path)


def write_frame(file: RecordingFile, frame: RecordedFrame, settings: RecorderSettings) -> None:
    """Write one processed frame: its image, its mask and its result. May raise OSError."""
    captured_at_s = frame.record.captured_at_s
    if frame.image is not None and settings.image != "none":
        file.image(frame.finger, captured_at_s, _encode(frame.image, settings), settings.image)
    if frame.mask is not None:
        mask = resize_mask_to_frame(frame.mask) * np.uint8(255)
        file.mask(frame.finger, captured_at_s, cv2.imencode(".png", mask)[1].tobytes())
    file.frame(frame.finger, frame.at_s, frame.record)


def _encode(image: NDArray[np.uint8], settings: RecorderSettings) -> bytes:
    if settings.image == "png":
        return cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes()
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, settings.jpeg_quality])[1].tobytes()
