"""The folder of recordings: a ring of the last minutes, and what is kept because something happened.

<folder>/ring/20261121T143012.250Z.mcap    the newest are written, the oldest deleted
<folder>/kept/20261121T142952.250Z.mcap    around every slip and fault; the oldest deleted beyond the limit

A name tells when a file began, by the wall clock of then; which is older tells the time of its last change, and what
was changed in the future was written while the clock was wrong: it goes first.

A part of the disk stays free: what a restart is told of the grip lies on it too, and must be written when it changes.
"""

from __future__ import annotations

import contextlib
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

SUFFIX = ".mcap"
MAGIC = b"\x89MCAP0\r\n"
CLOCK_STEP_MAX_S = 60.0
"""A file changed by so much later than now is no new one: the clock was wrong then."""
RESERVE_SHARE = 0.05
RESERVE_MAX_BYTES = 256 * 2**20
"""So much of the disk stays free, or the share of it where that is less."""
FILE_MIN_BYTES = 2 * 2**20
"""No smaller part of the ring is worth a file: each begins with the no-contact images, some 300 kB."""


class NoRoom(OSError):
    """No more can be recorded without using the part of the disk that stays free."""


@dataclass(frozen=True, slots=True)
class RingLimits:
    """How much may lie in the folder. ring_files: how many files the ring has, 1 or more; whatever is older goes."""

    ring_files: int
    ring_bytes: int
    kept_bytes: int


class Ring:
    """Names, keeps and deletes recordings; writes none. Every method may raise OSError.

    usage: bytes of the disk a folder lies on: in all, used, free.
    """

    def __init__(
        self, folder: Path, limits: RingLimits, usage: Callable[[Path], tuple[int, int, int]] = shutil.disk_usage
    ) -> None:
        self.ring, self.kept = folder / "ring", folder / "kept"
        self._limits, self._usage = limits, usage

    def new(self, wall_ns: int) -> Path:
        """Where the recording that begins now is written."""
        self.ring.mkdir(parents=True, exist_ok=True)
        self.kept.mkdir(exist_ok=True)  # now: a full disk lets files be moved, and makes no folder
        began = datetime.fromtimestamp(wall_ns * 1e-9, UTC)
        name = f"{began:%Y%m%dT%H%M%S}.{began.microsecond // 1000:03d}Z"
        path = self.ring / (name + SUFFIX)
        again = 1
        while path.exists() or (self.kept / path.name).exists():  # a wall clock may be set back
            path = self.ring / f"{name}-{again}{SUFFIX}"
            again += 1
        return path

    def keep(self, path: Path) -> Path:
        """Move a finished recording out of the ring; returns where it is now. Older ones make room for it before."""
        if path.parent == self.kept:
            return path
        self.kept.mkdir(parents=True, exist_ok=True)
        _delete_beyond(_newest_first(self.kept, also=path), None, self._limits.kept_bytes, path)
        return path.rename(self.kept / path.name)

    def keep_unfinished(self) -> None:
        """Keep what a killed daemon left behind: somebody will ask what happened then."""
        for path, _ in _newest_first(self.ring):
            if not _finished(path):
                self.keep(path)

    def ended(self) -> list[tuple[Path, int]]:
        """The ring's files, the oldest first, and when each was last changed, nanoseconds since 1970.

        None of a future that never was.
        """
        latest_ns = round(1e9 * (time.time() + CLOCK_STEP_MAX_S))
        found = []
        for path, _ in reversed(_newest_first(self.ring)):
            with contextlib.suppress(FileNotFoundError):  # somebody takes one away while we look
                found.append((path, path.stat().st_mtime_ns))
        return [(path, changed_ns) for path, changed_ns in found if changed_ns <= latest_ns]

    def file_bytes(self) -> int:
        """A file this large is followed by a new one, so that the ring can give back a part of itself."""
        share = max(self._limits.ring_bytes // self._limits.ring_files, FILE_MIN_BYTES)
        return min(share, _reserve_bytes(self._usage(self.ring)[0]) or share)  # some network folders tell no size

    def tidy(self, writing: Path | None = None) -> None:
        """Delete what is beyond the limits, the oldest first, but never the file that is being written.

        That one counts as if it were full, and an eighth for its index and the last it takes.
        """
        limits, full_bytes = self._limits, self.file_bytes() * 9 // 8 if writing is not None else 0
        ring = [(path, full_bytes if path == writing else size) for path, size in _newest_first(self.ring, writing)]
        _delete_beyond(ring, limits.ring_files, limits.ring_bytes, writing)
        _delete_beyond(_newest_first(self.kept), None, limits.kept_bytes, writing)

    def make_room(self, writing: Path | None = None, reserves: int = 1) -> None:
        """See that the part of the disk that stays free is free, `reserves` times over.

        What is missing the ring gives back, the oldest file first, but never the one that is being written. Raises
        NoRoom if that is not enough.
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
            raise NoRoom(f"less than {wanted / 2**20:.3g} MB of the disk are free")

    def give_back(self, spare: Path | None = None) -> bool:
        """Delete the ring's oldest file but `spare`; whether there was one."""
        for path, _ in reversed(_newest_first(self.ring)):
            if path != spare:
                path.unlink(missing_ok=True)
                return True
        return False


def _reserve_bytes(disk_bytes: int) -> int:
    return min(round(RESERVE_SHARE * disk_bytes), RESERVE_MAX_BYTES)


def _newest_first(folder: Path, writing: Path | None = None, also: Path | None = None) -> list[tuple[Path, int]]:
    """Recordings and their sizes in bytes; the one that is being written is the newest, whatever the clock says.

    also: one from elsewhere, in its place among them.
    """
    latest_s = time.time() + CLOCK_STEP_MAX_S
    found = []
    here = folder.glob(f"*{SUFFIX}") if folder.is_dir() else ()
    for path in (*here, also) if also is not None else here:
        with contextlib.suppress(FileNotFoundError):  # somebody takes one away while we look
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
    """An MCAP file ends as it begins, with its magic."""
    with path.open("rb") as file:
        file.seek(max(path.stat().st_size - len(MAGIC), 0))
        return file.read() == MAGIC
