"""An event loop whose clock jumps to the next deadline instead of waiting for it.

The same coroutines run unchanged: an hour of guarding takes seconds, and twice the same seed gives twice the same
result. Work handed to an executor is done on the spot, so nothing depends on how fast the machine is.
"""

from __future__ import annotations

import asyncio
import selectors
from collections.abc import Callable, Coroutine
from typing import Any, TypeVar

T = TypeVar("T")


class _JumpingSelector(selectors.DefaultSelector):  # type: ignore[misc, unused-ignore]
    """Polls its files without waiting; where the loop would have waited, moves its clock instead."""

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
    """`time()` starts at `start_s` and moves only when every task waits for a later moment."""

    def __init__(self, start_s: float = 1000.0) -> None:
        self._jumping = _JumpingSelector()
        self._jumping.now_s = start_s
        super().__init__(self._jumping)
        # Timers closer than this count as due; the default is the real clock's resolution.
        self._clock_resolution = 1e-9

    def time(self) -> float:
        """Virtual seconds."""
        return self._jumping.now_s

    def stand_still(self, for_s: float) -> None:
        """Let time pass while nothing runs, as when the machine is busy with something else."""
        self._jumping.now_s += for_s

    def run_in_executor(self, executor: Any, func: Callable[..., T], *args: Any) -> asyncio.Future[T]:  # type: ignore[override]
        """Call `func` now, in this thread, and return its finished future."""
        future: asyncio.Future[T] = self.create_future()
        try:
            future.set_result(func(*args))
        except Exception as error:
            future.set_exception(error)
        return future


def run_virtual(main: Coroutine[Any, Any, T], start_s: float = 1000.0) -> T:
    """Run `main` to its end on a fresh virtual clock."""
    with asyncio.Runner(loop_factory=lambda: VirtualTimeLoop(start_s)) as runner:
        return runner.run(main)
