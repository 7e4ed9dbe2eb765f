"""One question to the daemon for all who ask at the same time."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import Generic, TypeVar

T = TypeVar("T")


class TtlCache(Generic[T]):
    """What `ask` gives, asked again only when the last answer is older than `keep_s`, however many want it.

    A failure is told to all who waited for it, and not kept.
    """

    def __init__(self, ask: Callable[[], Awaitable[T]], keep_s: float) -> None:
        self._ask, self._keep_s = ask, keep_s
        self._asking: asyncio.Task[T] | None = None
        self._asked_at_s = float("-inf")

    async def get(self) -> T:
        """The answer, at most `keep_s` old when asked for."""
        now_s = asyncio.get_running_loop().time()
        asking = self._asking
        stale = asking is not None and asking.done() and (now_s - self._asked_at_s > self._keep_s or _failed(asking))
        if asking is None or stale:
            self._asked_at_s = now_s
            asking = self._asking = asyncio.create_task(self._once(), name="web: ask the daemon")
        return await asyncio.shield(asking)

    def forget(self) -> None:
        """The next one who asks gets what is so from now on."""
        self._asking = None

    async def _once(self) -> T:
        return await self._ask()


def _failed(task: asyncio.Task[T]) -> bool:
    return task.cancelled() or task.exception() is not None
