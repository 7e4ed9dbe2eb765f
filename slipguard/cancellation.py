"""Cancellation in asyncio: tasks that end for certain, and timers that are cancelled together."""

from __future__ import annotations

import asyncio
import itertools
from collections.abc import Callable


def raise_if_cancelled() -> None:
    """Raise CancelledError if this task was cancelled and the awaited call swallowed the cancellation.

    For loops that continue after any error of a driver or a library. Before Python 3.12, `asyncio.wait_for` swallows a
    cancellation that arrives together with its result. An error raised during cleanup also replaces the cancellation.
    """
    task = asyncio.current_task()
    if task is not None and task.cancelling():
        raise asyncio.CancelledError


async def cancel_and_wait(task: asyncio.Task[None] | None) -> None:
    """Cancel a task and wait until it has ended; does nothing for None.

    Raises:
        Exception: the error that the task itself raised.
        CancelledError: if the caller is cancelled while it waits.
    """
    if task is None:
        return
    task.cancel()
    await asyncio.wait([task])
    if not task.cancelled():
        task.result()


class TimerGroup:
    """Timers of the running loop that are cancelled together. A timer that has fired leaves no reference cycle."""

    def __init__(self) -> None:
        self._ids = itertools.count()
        self._waiting: dict[int, asyncio.TimerHandle] = {}

    def call_at(self, when_s: float, callback: Callable[[], object]) -> None:
        """Call `callback` at an absolute loop time, unless it is cancelled before."""
        timer_id = next(self._ids)

        def fire() -> None:
            del self._waiting[timer_id]
            callback()

        self._waiting[timer_id] = asyncio.get_running_loop().call_at(when_s, fire)

    def cancel_all(self) -> None:
        """Cancel every timer that has not fired yet."""
        for timer in self._waiting.values():
            timer.cancel()
        self._waiting.clear()
