"""A shutdown that ends: what does not heed it is named and cancelled again, and at last the process leaves all behind.

The grip stays as it is however the process ends, and its children follow it.
"""

from __future__ import annotations

import asyncio
import os
import threading
from collections.abc import Callable

import structlog

AGAIN_S = 6.0
"""The web process may take 5 s for its last answers, and so may the recorder for its file."""
LEAVE_S = 8.0
"""A thread that hangs, or a loop that stands still, heeds nothing. Less than the unit's `TimeoutStopSec`."""
log = structlog.get_logger()


class Shutdown:
    """Made in the task that waits for all others. leave: ends the process on the spot, with its exit status."""

    def __init__(self, leave: Callable[[int], None] = os._exit) -> None:
        self._waits = asyncio.current_task()
        self._loop = asyncio.get_running_loop()
        self._leave = leave
        self._again: asyncio.TimerHandle | None = None
        self._last: threading.Timer | None = None

    def begin(self) -> None:
        """The other tasks are about to be cancelled. To be called once."""
        self._again = self._loop.call_later(AGAIN_S, self._cancel_again)
        self._last = threading.Timer(LEAVE_S, self._leave_all)  # not on the loop, which may be what stands still
        self._last.daemon = True
        self._last.start()

    def over(self) -> None:
        """All have ended. Idempotent."""
        if self._again is not None:
            self._again.cancel()
        if self._last is not None:
            self._last.cancel()

    def _late(self) -> list[asyncio.Task[object]]:
        return [task for task in asyncio.all_tasks(self._loop) if task.cancelling() and task is not self._waits]

    def _cancel_again(self) -> None:
        late = self._late()
        log.error(f"not ended {AGAIN_S:g} s after the stop; cancelled again", tasks=_names(late))
        for task in late:
            task.cancel()

    def _leave_all(self) -> None:
        try:
            log.error(
                f"not ended {LEAVE_S:g} s after the stop; left behind, the grip stays", tasks=_names(self._late())
            )
        finally:
            self._leave(1)


def _names(tasks: list[asyncio.Task[object]]) -> list[str]:
    return sorted(task.get_name() for task in tasks)
