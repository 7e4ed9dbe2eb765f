"""The folder of recordings: a ring of the last minutes, and the files kept around slips and faults.

<folder>/ring/20261121T143012.250Z.mcap    newest are written, oldest deleted
<folder>/kept/20261121T142952.250Z.mcap    around every slip and fault; oldest deleted beyond the limit

The name is the wall-clock time at which the file began. Files are ordered by the time of their last change. A change in
the future means that the clock was wrong; such a file counts as the oldest.

A part of the disk stays free, because the state for a restart is stored on it too.
"""

from __future__ import annotations

import contextlib
import shutil
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from slipguard.recording.writer import RecordingClock

SUFFIX = ".mcap"
MAGIC = b"\x89MCAP0\r\n"
CLOCK_STEP_MAX_S = 60.0
"""A file changed later than this in the future was written while the clock was wrong."""
RESERVE_SHARE = 0.05
RESERVE_MAX_BYTES = 256 * 2**20
"""This much of the disk stays free, or `RESERVE_SHARE` of it if that is less."""
FILE_MIN_BYTES = 2 * 2**20
"""Smallest size at which a file ends: each begins with the background images, some 300 kB."""
FOLDER_MODE = 0o750
"""Recordings show the cell: for the daemon's user and its group only."""
FILES_MAX = 5000
"""Ended files that are remembered: the longest ring, of one day."""


class NoRoom(OSError):
    """Nothing more can be recorded without using the part of the disk that stays free."""


@dataclass(frozen=True, slots=True)
class RingLimits:
    """Size of the folder. ring_files: number of files in the ring, 1 or more."""

    ring_files: int
    ring_bytes: int
    kept_bytes: int


class Ring:
    """Names, keeps and deletes recordings. Every method may raise OSError.

    Args:
        folder: Holds the folders `ring` and `kept`.
        limits: How much may be in them.
        usage: Returns the bytes of the disk of a folder: total, used, free.
    """

    def __init__(
        self, folder: Path, limits: RingLimits, usage: Callable[[Path], tuple[int, int, int]] = shutil.disk_usage
    ) -> None:
        self.ring, self.kept = folder / "ring", folder / "kept"
        self._limits, self._usage = limits, usage

    def new(self, wall_ns: int) -> Path:
        """Return the path of the recording that begins now."""
        for folder in (
            self.ring.parent,
            self.ring,
            self.kept,
        ):  # now: on a full disk files can be moved, not folders made
            folder.mkdir(mode=FOLDER_MODE, parents=True, exist_ok=True)
        began = datetime.fromtimestamp(wall_ns * 1e-9, UTC)
        name = f"{began:%Y%m%dT%H%M%S}.{began.microsecond // 1000:03d}Z"
        path = self.ring / (name + SUFFIX)
        repetition = 1
        while path.exists() or (self.kept / path.name).exists():  # the wall clock may be set back
            path = self.ring / f"{name}-{repetition}{SUFFIX}"
            repetition += 1
        return path

    def keep(self, path: Path) -> Path:
        """Move a finished recording out of the ring, after making room for it; return its new path."""
        if path.parent == self.kept:
            return path
        self.kept.mkdir(mode=FOLDER_MODE, parents=True, exist_ok=True)
        _delete_beyond(_newest_first(self.kept, also=path), None, self._limits.kept_bytes, path)
        return path.rename(self.kept / path.name)

    def keep_unfinished(self) -> None:
        """Keep the files of a killed daemon, because they show what happened."""
        for path, _ in _newest_first(self.ring):
            if not _finished(path):
                self.keep(path)

    def ended(self) -> list[tuple[Path, int]]:
        """Return the ring's files, oldest first, with the time of their last change in nanoseconds since 1970.

        Files changed in the future are left out.
        """
        latest_ns = round(1e9 * (time.time() + CLOCK_STEP_MAX_S))
        found = []
        for path, _ in reversed(_newest_first(self.ring)):
            with contextlib.suppress(FileNotFoundError):  # it may have been deleted since it was listed
                found.append((path, path.stat().st_mtime_ns))
        return [(path, changed_ns) for path, changed_ns in found if changed_ns <= latest_ns]

    def file_bytes(self) -> int:
        """Return the size at which a file ends, so that the ring can be freed file by file."""
        share = max(self._limits.ring_bytes // self._limits.ring_files, FILE_MIN_BYTES)
        return min(share, _reserve_bytes(self._usage(self.ring)[0]) or share)  # some network folders report no size

    def tidy(self, writing: Path | None = None) -> None:
        """Delete the oldest files beyond the limits, but never the one that is being written.

        That one counts with its full size, and an eighth for its index and its last data.
        """
        limits, full_bytes = self._limits, self.file_bytes() * 9 // 8 if writing is not None else 0
        ring = [(path, full_bytes if path == writing else size) for path, size in _newest_first(self.ring, writing)]
        _delete_beyond(ring, limits.ring_files, limits.ring_bytes, writing)
        _delete_beyond(_newest_first(self.kept), None, limits.kept_bytes, writing)

    def make_room(self, writing: Path | None = None, reserves: int = 1) -> None:
        """Make sure that `reserves` times the reserve of the disk is free.

        Deletes the ring's oldest files if necessary, but never the one that is being written. Raises NoRoom if that is
        not sufficient.
        """
        total, _, free = self._usage(self.ring)
        wanted = _reserve_bytes(total) * reserves
        if free >= wanted:
            return
        for path, size in reversed(_newest_first(self.ring, writing)):
            if path != writing and free < wanted:
                path.unlink(missing_ok=True)
                free += size
        if free < wanted:
            raise NoRoom(f"{max(free, 0) / 2**20:.3g} MB of the disk are free (limit {wanted / 2**20:.3g} MB)")

    def delete_oldest(self, spare: Path | None = None) -> bool:
        """Delete the ring's oldest file except `spare`; return whether there was one."""
        for path, _ in reversed(_newest_first(self.ring)):
            if path != spare:
                path.unlink(missing_ok=True)
                return True
        return False


class Retention:
    """Decides which files are kept: those from some time before an event to some time after it.

    Times are the event loop's, in seconds. Methods that move files may raise OSError; the next call tries again.
    """

    def __init__(self, ring: Ring, before_s: float, after_s: float) -> None:
        self._ring, self._before_s, self._after_s = ring, before_s, after_s
        self._ended: deque[tuple[Path, float]] = deque(maxlen=FILES_MAX)
        self._to_keep: deque[Path] = deque(maxlen=FILES_MAX)
        self._until_s = float("-inf")
        self._keep_current = False

    def add_existing(self, clock: Callable[[], RecordingClock]) -> None:
        """Take the files of earlier runs into account; an event soon after the start keeps them too."""
        ended = self._ring.ended()
        if ended:
            now = clock()
            self._ended.extend((path, now.s(changed_ns)) for path, changed_ns in ended)

    def add_event(self, now_s: float) -> None:
        """Keep the current file, files that begin soon, and ended files that reach far enough back."""
        self._until_s = now_s + self._after_s
        self._keep_current = True
        while self._ended and self._ended[-1][1] >= now_s - self._before_s:
            self._to_keep.append(self._ended.pop()[0])
        self._ended.clear()
        self.move()

    def file_began(self, now_s: float) -> None:
        self._keep_current = now_s <= self._until_s

    def file_ended(self, path: Path, last_s: float) -> None:
        """Note that the current file ended, complete or not. Moves nothing yet."""
        if self._keep_current:
            self._to_keep.append(path)
        else:
            self._ended.append((path, last_s))

    def move(self) -> None:
        while self._to_keep:
            if self._to_keep[0].exists():
                self._ring.keep(self._to_keep[0])
            self._to_keep.popleft()


def _reserve_bytes(disk_bytes: int) -> int:
    return min(round(RESERVE_SHARE * disk_bytes), RESERVE_MAX_BYTES)


def _newest_first(folder: Path, writing: Path | None = None, also: Path | None = None) -> list[tuple[Path, int]]:
    """Return recordings with their sizes in bytes; the one that is being written counts as the newest.

    also: a file from another folder that is sorted in.
    """
    latest_s = time.time() + CLOCK_STEP_MAX_S
    found = []
    paths = folder.glob(f"*{SUFFIX}") if folder.is_dir() else ()
    for path in (*paths, also) if also is not None else paths:
        with contextlib.suppress(FileNotFoundError):  # it may have been deleted since it was listed
            facts = path.stat()
            age = (path == writing, facts.st_mtime <= latest_s, facts.st_mtime_ns, path.name)
            found.append((age, path, facts.st_size))
    return [(path, size) for _, path, size in sorted(found, reverse=True)]


def _delete_beyond(
    newest_first: list[tuple[Path, int]], files: int | None, size_bytes: int, spare: Path | None
) -> None:
    total_bytes = 0
    for number, (path, size) in enumerate(newest_first):
        total_bytes += size
        if path != spare and ((files is not None and number >= files) or total_bytes > size_bytes):
            path.unlink(missing_ok=True)


def _finished(path: Path) -> bool:
    with path.open("rb") as file:
        file.seek(max(path.stat().st_size - len(MAGIC), 0))
        return file.read() == MAGIC
