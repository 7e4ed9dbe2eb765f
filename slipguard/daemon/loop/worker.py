"""Where the computations of one finger run: in a thread of its own, or at once on a virtual clock."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Protocol, TypeVar

from slipguard.thread_priority import set_worker_priority

A = TypeVar("A")
T = TypeVar("T")


class Worker(Protocol):
    """Runs one call at a time, in order."""

    async def run(self, work: Callable[[A], T], argument: A) -> T:
        """Return `work(argument)`."""
        ...

    def waited_s(self) -> float | None:
        """Return for how long its thread has waited for a processor since its start; None if that is unknown."""
        ...

    def close(self) -> None:
        """End the worker's thread, if it has one."""
        ...


class ThreadWorker:
    """A worker with one thread, so that numpy and onnxruntime do not block the event loop."""

    def __init__(self, name: str) -> None:
        self._thread_id = 0
        self._pool = ThreadPoolExecutor(1, f"slipguard-{name}", initializer=self._begin)

    def _begin(self) -> None:
        set_worker_priority()
        self._thread_id = threading.get_native_id()

    async def run(self, work: Callable[[A], T], argument: A) -> T:
        return await asyncio.get_running_loop().run_in_executor(self._pool, work, argument)

    def waited_s(self) -> float | None:
        try:
            schedstat = Path(f"/proc/self/task/{self._thread_id}/schedstat").read_bytes()
        except OSError:
            return None
        return int(schedstat.split()[1]) / 1e9

    def close(self) -> None:
        self._pool.shutdown(wait=True, cancel_futures=True)


class FixedLatencyWorker:
    """A worker for the virtual clock, on which a computation takes no time.

    Calls `work` at once and returns its result `latency_s` later on the loop's clock.
    """

    def __init__(self, latency_s: float) -> None:
        self.latency_s = latency_s

    async def run(self, work: Callable[[A], T], argument: A) -> T:
        deadline_s = asyncio.get_running_loop().time() + self.latency_s
        result = work(argument)
        await asyncio.sleep(max(0.0, deadline_s - asyncio.get_running_loop().time()))
        return result

    def waited_s(self) -> float | None:
        """Return None: there is no thread that could wait for a processor."""
        return None

    def close(self) -> None:
        """Do nothing: there is no thread."""
