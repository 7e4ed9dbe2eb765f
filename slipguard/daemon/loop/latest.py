"""A slot that holds the newest value only: old news is dropped, and counted."""

from __future__ import annotations

import asyncio
from typing import Generic, TypeVar

T = TypeVar("T")


class Latest(Generic[T]):
    """One writer's newest value for one waiting reader."""

    def __init__(self) -> None:
        self._value: T | None = None
        self._news = asyncio.Event()
        self.overwritten = 0
        """How many values were replaced before anyone took them."""

    def put(self, value: T) -> None:
        """Replace what is there."""
        self.overwritten += self._news.is_set()
        self._value = value
        self._news.set()

    def take(self) -> T | None:
        """The newest value not yet taken, or None. Does not wait."""
        if not self._news.is_set():
            return None
        self._news.clear()
        value, self._value = self._value, None
        return value

    async def next(self) -> T:
        """Wait for a value not yet taken, and take it."""
        while True:
            await self._news.wait()
            value = self.take()
            if value is not None:
                return value
