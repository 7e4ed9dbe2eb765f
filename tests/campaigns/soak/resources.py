"""The resources of a process at one moment: memory, tasks, threads, descriptors, children, files. Linux only."""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import functools
import os
import sys
import threading
from dataclasses import dataclass
from pathlib import Path

PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")
MB = 2**20


@dataclass(frozen=True, slots=True)
class ResourceSample:
    """The resources at one moment.

    Attributes:
        rss_mb, children_mb: resident memory of this process, and of its children together.
        blocks: memory blocks allocated by Python.
        files: open descriptors.
        state_files: files in the state directory outside the recordings.
        ring_files, ring_mb, kept_mb: of the two folders of recordings.
    """

    at_s: float
    rss_mb: float
    children_mb: float
    blocks: int
    tasks: int
    threads: int
    files: int
    children: int
    state_files: int
    ring_files: int
    ring_mb: float
    kept_mb: float


def return_freed_memory() -> None:
    """Return freed memory to the system, so that resident memory is memory in use. Does nothing without glibc."""
    with contextlib.suppress(OSError, AttributeError):
        _libc().malloc_trim(0)


@functools.cache
def _libc() -> ctypes.CDLL:
    """Load libc once: each load leaves a class of a hundred blocks to the garbage collector."""
    return ctypes.CDLL("libc.so.6")


def take_sample(at_s: float, state: Path, recordings: Path) -> ResourceSample:
    """Return the resources of this process; call it in the event loop's thread."""
    children = child_processes()
    ring, kept = _sizes(recordings / "ring"), _sizes(recordings / "kept")
    return ResourceSample(
        at_s=at_s,
        rss_mb=_resident_mb("self"),
        children_mb=sum(_resident_mb(str(child)) for child in children),
        blocks=sys.getallocatedblocks(),
        tasks=len(asyncio.all_tasks()),
        threads=threading.active_count(),
        files=len(os.listdir("/proc/self/fd")),
        children=len(children),
        state_files=sum(path.is_file() and recordings not in path.parents for path in state.rglob("*")),
        ring_files=len(ring),
        ring_mb=sum(ring) / MB,
        kept_mb=sum(kept) / MB,
    )


def child_processes() -> list[int]:
    """Return the process ids of the children of this process."""
    return [int(one) for path in Path("/proc/self/task").glob("*/children") for one in _text(path).split()]


def _resident_mb(process: str) -> float:
    words = _text(Path("/proc") / process / "statm").split()
    return int(words[1]) * PAGE_BYTES / MB if words else 0.0


def _text(path: Path) -> str:
    """Return the text of a file, empty if its process or thread has just ended."""
    with contextlib.suppress(OSError):
        return path.read_text()
    return ""


def _sizes(folder: Path) -> list[int]:
    sizes = []
    for path in folder.glob("*"):
        with contextlib.suppress(FileNotFoundError):  # the ring deletes files meanwhile
            sizes.append(path.stat().st_size)
    return sizes
