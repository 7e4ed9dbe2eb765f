"""Where the heavy calls run: one thread per finger, or on the spot with a stated latency."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Protocol, TypeVar

from slipguard.thread_priority import set_worker_priority

T = TypeVar("T")
A = TypeVar("A")


class Worker(Protocol):
    """Runs one call at a time, in order."""

    async def run(self, work: Callable[[A], T], argument: A) -> T:
        """Await `work(argument)`."""
        ...

    def close(self) -> None:
        """Let go of the thread, if there is one."""
        ...


class ThreadWorker:
    """One thread of its own: the event loop stays free while numpy and onnxruntime work."""

    def __init__(self, name: str) -> None:
        self._pool = ThreadPoolExecutor(1, f"slipguard-{name}", initializer=set_worker_priority)

    async def run(self, work: Callable[[A], T], argument: A) -> T:
        return await asyncio.get_running_loop().run_in_executor(self._pool, work, argument)

    def close(self) -> None:
        self._pool.shutdown(wait=True, cancel_futures=True)


class StatedLatencyWorker:
    """Runs the call on the spot and delivers its result `latency_s` later on the loop's clock.

    For the virtual clock, where a computation takes no time of its own.
    """

    def __init__(self, latency_s: float) -> None:
        self.latency_s = latency_s

    async def run(self, work: Callable[[A], T], argument: A) -> T:
        deadline_s = asyncio.get_running_loop().time() + self.latency_s
        result = work(argument)
        await asyncio.sleep(max(0.0, deadline_s - asyncio.get_running_loop().time()))
        return result

    def close(self) -> None:
        """Nothing to let go of."""
