"""An event loop whose clock jumps to the next deadline instead of waiting for it.

The same coroutines run unchanged: an hour of guarding takes seconds, and the same seed always gives the same result.
Executors run their work immediately in the loop's thread, so nothing depends on the speed of the machine.
"""

from __future__ import annotations

import asyncio
import selectors
from collections.abc import Callable, Coroutine
from typing import Any, TypeVar

T = TypeVar("T")
START_S = 1000.0


class _JumpingSelector(selectors.DefaultSelector):  # type: ignore[misc, unused-ignore]
    """Polls its files without waiting, and advances its clock where the loop would have waited."""

    def __init__(self) -> None:
        super().__init__()
        self.now_s = START_S

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        ready = super().select(0)
        if ready or timeout == 0:
            return ready
        if timeout is None:
            return super().select(None)
        self.now_s += max(0.0, timeout)
        return []


class VirtualTimeLoop(asyncio.SelectorEventLoop):
    """Virtual clock: starts at `START_S`, and advances only when every task waits."""

    def __init__(self) -> None:
        self._jumping = _JumpingSelector()
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


def run_virtual(main: Coroutine[Any, Any, T]) -> T:
    """Run `main` to its end on a new virtual clock and return its result."""
    with asyncio.Runner(loop_factory=VirtualTimeLoop) as runner:
        return runner.run(main)
