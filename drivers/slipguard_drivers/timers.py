"""Calls at times of the loop that can all be taken back together."""

from __future__ import annotations

import asyncio
import itertools
from collections.abc import Callable


class TimerGroup:
    """What waits to be called. Nothing of a call that was made stays, not even for the garbage collector."""

    def __init__(self) -> None:
        self._numbers = itertools.count()
        self._waiting: dict[int, asyncio.TimerHandle] = {}

    def at(self, when_s: float, call: Callable[[], object]) -> None:
        """Call at an absolute time of the running loop, unless taken back by then."""
        number = next(self._numbers)

        def fire() -> None:
            del self._waiting[number]
            call()

        self._waiting[number] = asyncio.get_running_loop().call_at(when_s, fire)

    def cancel_all(self) -> None:
        """Nothing that waits is called any more."""
        for timer in self._waiting.values():
            timer.cancel()
        self._waiting.clear()
