"""An event loop whose clock jumps to the next deadline instead of waiting for it.

The same coroutines run unchanged: an hour of guarding takes seconds, and the same seed always gives the same result.
Executors run their work immediately in the loop's thread, so nothing depends on the speed of the machine.
"""

from __future__ import annotations

import asyncio
import selectors
from collections.abc import Callable, Coroutine
from typing import Any, TypeVar

A = TypeVar("A")
T = TypeVar("T")


class _JumpingSelector(selectors.DefaultSelector):  # type: ignore[misc, unused-ignore]
    """Polls its files without waiting, and advances its clock where the loop would have waited."""

    def __init__(self) -> None:
        super().__init__()
        self.now_s = 0.0

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        ready = super().select(0)
        if ready or timeout == 0:
            return ready
        if timeout is None:
            return super().select(None)
        self.now_s += max(0.0, timeout)
        return []


class VirtualTimeLoop(asyncio.SelectorEventLoop):
    """Virtual clock: starts at `start_s`, and advances only when every task waits."""

    def __init__(self, start_s: float = 1000.0) -> None:
        self._jumping = _JumpingSelector()
        self._jumping.now_s = start_s
        super().__init__(self._jumping)
        # Timers closer than this count as due; the default is the real clock's resolution.
        self._clock_resolution = 1e-9

    def time(self) -> float:
        """Return the virtual time in seconds."""
        return self._jumping.now_s

    def stand_still(self, for_s: float) -> None:
        """Advance the time while nothing runs, as on a machine that is busy with other programs."""
        self._jumping.now_s += for_s

    def run_in_executor(self, executor: Any, func: Callable[..., T], *args: Any) -> asyncio.Future[T]:  # type: ignore[override]
        """Call `func` now, in this thread, and return a finished future."""
        future: asyncio.Future[T] = self.create_future()
        try:
            future.set_result(func(*args))
        except Exception as error:
            future.set_exception(error)
        return future


def run_virtual(main: Coroutine[Any, Any, T], start_s: float = 1000.0) -> T:
    """Run `main` to its end on a new virtual clock and return its result."""
    with asyncio.Runner(loop_factory=lambda: VirtualTimeLoop(start_s)) as runner:
        return runner.run(main)


class FixedLatencyWorker:
    """A worker (see `slipguard.daemon.loop.finger`) for the virtual clock, on which a computation takes no time.

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
