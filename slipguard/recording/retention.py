"""Which of the recorded files are kept: those around an event, from some while before it to some while after."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from pathlib import Path

from slipguard.recording.ring import Ring
from slipguard.recording.writer import RecordingClock

FILES_MAX = 5000
"""Files that are remembered: the longest ring there is, of a day."""


class Retention:
    """Told of each file's beginning and end, and of events; moves what is worth it out of the ring.

    Times are the event loop's, in seconds. What moves files may raise OSError; they are tried again with the next.
    """

    def __init__(self, ring: Ring, before_s: float, after_s: float) -> None:
        self._ring, self._before_s, self._after_s = ring, before_s, after_s
        self._ended: deque[tuple[Path, float]] = deque(maxlen=FILES_MAX)
        self._to_keep: deque[Path] = deque(maxlen=FILES_MAX)
        self._until_s = float("-inf")
        self._this = False

    def look_back(self, clock: Callable[[], RecordingClock]) -> None:
        """What lies in the ring already is worth keeping as well, if something happens at once."""
        ended = self._ring.ended()
        if ended:
            now = clock()
            self._ended.extend((path, now.s(changed_ns)) for path, changed_ns in ended)

    def event(self, now_s: float) -> None:
        """Keep the present file, what begins soon, and the ended files that reach far enough back."""
        self._until_s = now_s + self._after_s
        self._this = True
        while self._ended and self._ended[-1][1] >= now_s - self._before_s:
            self._to_keep.append(self._ended.pop()[0])
        self._ended.clear()
        self.move()

    def begun(self, now_s: float) -> None:
        """A file began."""
        self._this = now_s <= self._until_s

    def ended(self, path: Path, last_s: float) -> None:
        """The file that began last has ended, whole or not; nothing is moved yet."""
        if self._this:
            self._to_keep.append(path)
        else:
            self._ended.append((path, last_s))

    def move(self) -> None:
        """Move what is to be kept."""
        while self._to_keep:
            if self._to_keep[0].exists():
                self._ring.keep(self._to_keep[0])
            self._to_keep.popleft()
