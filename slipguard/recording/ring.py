"""The folder of recordings: a ring of the last minutes, and what is kept because something happened.

<folder>/ring/20261121T143012.250Z.mcap    the newest are written, the oldest deleted
<folder>/kept/20261121T142952.250Z.mcap    around every slip and fault; the oldest deleted beyond the limit

A name tells when a file began, by the wall clock of then; which is older tells the time of its last change, and what
was changed in the future was written while the clock was wrong: it goes first.
"""

from __future__ import annotations

import contextlib
import time
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

SUFFIX = ".mcap"
MAGIC = b"\x89MCAP0\r\n"
CLOCK_STEP_MAX_S = 60.0
"""A file changed by so much later than now is no new one: the clock was wrong then."""


@dataclass(frozen=True, slots=True)
class Limits:
    """How much may lie in the folder. ring_files: how many files the ring has; whatever is older goes."""

    ring_files: int
    ring_bytes: int
    kept_bytes: int


class Ring:
    """Names, keeps and deletes recordings; writes none. Every method may raise OSError."""

    def __init__(self, folder: Path, limits: Limits) -> None:
        self.ring, self.kept = folder / "ring", folder / "kept"
        self._limits = limits

    def new(self, wall_ns: int) -> Path:
        """Where the recording that begins now is written."""
        self.ring.mkdir(parents=True, exist_ok=True)
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

    def tidy(self, writing: Path | None = None) -> None:
        """Delete what is beyond the limits, the oldest first, but never the file that is being written."""
        limits = self._limits
        _delete_beyond(_newest_first(self.ring, writing), limits.ring_files, limits.ring_bytes, writing)
        _delete_beyond(_newest_first(self.kept), None, limits.kept_bytes, writing)


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
