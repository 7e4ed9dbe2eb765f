"""A cache that combines simultaneous calls to the daemon into one."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import Generic, TypeVar

T = TypeVar("T")


class TtlCache(Generic[T]):
    """Keeps the result of `fetch` for `ttl_s`. An exception goes to all callers that wait for it, and is not kept."""

    def __init__(self, fetch: Callable[[], Awaitable[T]], ttl_s: float) -> None:
        self._fetch, self._ttl_s = fetch, ttl_s
        self._task: asyncio.Task[T] | None = None
        self._started_at_s = float("-inf")

    async def get(self) -> T:
        """Return the result; its `fetch` started at most `ttl_s` ago."""
        now_s = asyncio.get_running_loop().time()
        task = self._task
        expired = task is not None and task.done() and (now_s - self._started_at_s > self._ttl_s or _failed(task))
        if task is None or expired:
            self._started_at_s = now_s
            task = self._task = asyncio.create_task(self._run(), name="web: call the daemon")
        return await asyncio.shield(task)

    def invalidate(self) -> None:
        """Make the next `get` fetch."""
        self._task = None

    async def _run(self) -> T:
        return await self._fetch()


def _failed(task: asyncio.Task[T]) -> bool:
    return task.cancelled() or task.exception() is not None
