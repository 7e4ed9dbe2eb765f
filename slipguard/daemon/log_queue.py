"""Entries on their way to the log. A terminal or journal that accepts nothing never blocks the control loop.

A thread writes the entries. While the output is blocked, the newest wait. Older ones are lost, counted and reported.
"""

from __future__ import annotations

import contextlib
import os
import select
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Generic, TextIO, TypeVar

from slipguard.thread_priority import set_worker_priority

E = TypeVar("E")
ENTRIES_MAX = 1000
"""About 200 kB."""


class LogQueue(Generic[E]):
    """A bounded queue with one writing thread, which starts with the first entry.

    Args:
        write: Writes one entry; may block; an exception loses the entry.
        on_lost: Called in the thread with the number of entries lost since the start and the seconds for which the
            output was blocked. What it reports may itself be lost; the next report has the same total or more.
        entries_max: How many entries may wait.
    """

    def __init__(
        self, write: Callable[[E], object], on_lost: Callable[[int, float], None], entries_max: int = ENTRIES_MAX
    ) -> None:
        self.lost = 0
        """Entries lost since the start."""
        self._write, self._on_lost = write, on_lost
        self._waiting: deque[E] = deque()
        self._entries_max = entries_max
        self._reported = 0
        self._changed = threading.Condition()
        self._thread: threading.Thread | None = None
        self._writing = self._closed = False

    def put(self, entry: E) -> None:
        """Add one entry. Never waits for the output."""
        with self._changed:
            if self._closed:
                return
            if len(self._waiting) >= self._entries_max:
                self._waiting.popleft()
                self.lost += 1
            self._waiting.append(entry)
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="slipguard-log", daemon=True)
                self._thread.start()
            self._changed.notify_all()

    def flush(self, timeout_s: float = 1.0) -> bool:
        """Wait until every entry is written, for at most `timeout_s`; return whether it is."""
        with self._changed:
            return self._changed.wait_for(lambda: not (self._waiting or self._writing), timeout_s)

    def close(self, timeout_s: float = 1.0) -> None:
        """Flush, and end the thread; one whose output is blocked ends later."""
        self.flush(timeout_s)
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def _run(self) -> None:
        set_worker_priority()
        blocked_s = 0.0
        while True:
            with self._changed:
                self._writing = False
                self._changed.notify_all()
                self._changed.wait_for(lambda: self._waiting or self._closed)
                if self._closed:
                    return
                entry, self._writing = self._waiting.popleft(), True
                lost, room = self.lost, len(self._waiting) < self._entries_max - 1
            if lost > self._reported and room:
                self._reported = lost
                with contextlib.suppress(Exception):
                    self._on_lost(lost, blocked_s)
                blocked_s = 0.0
            started_s = time.monotonic()
            with contextlib.suppress(Exception):  # the thread must go on: there is no other
                self._write(entry)
            blocked_s = max(blocked_s, time.monotonic() - started_s)


class StreamOutput:
    """Writes lines to a stream without its buffer, whose lock a blocked write would hold at the interpreter's end.

    stream: None if the process has no stderr.
    """

    def __init__(self, stream: TextIO | None) -> None:
        self._stream = stream
        self._fd: int | None = None
        if stream is not None:
            with contextlib.suppress(OSError, ValueError):
                self._fd = os.dup(stream.fileno())  # its own: the stream's number may be reused after it was closed

    def write(self, line: str) -> None:
        """Write one line and its end completely; may block. Raises OSError, or ValueError for a closed stream."""
        if self._fd is None:
            if self._stream is not None:
                self._stream.write(f"{line}\n")
                self._stream.flush()
            return
        rest = f"{line}\n".encode(errors="replace")
        while rest:
            try:
                rest = rest[os.write(self._fd, rest) :]
            except BlockingIOError:
                select.select((), (self._fd,), ())  # another program has set the shared terminal to non-blocking

    def __del__(self) -> None:
        if self._fd is not None and os is not None:  # at the interpreter's end the module may be gone
            os.close(self._fd)
