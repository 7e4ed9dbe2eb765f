"""Small asyncio helpers of the loop: newest value, ticks with absolute deadlines, pauses between retries."""

from __future__ import annotations

import asyncio
import math
from typing import Generic, TypeVar

T = TypeVar("T")


class LatestValue(Generic[T]):
    """A slot with one writer and one waiting reader. A new value replaces one that was not taken."""

    def __init__(self) -> None:
        self._value: T | None = None
        self._is_set = asyncio.Event()
        self.overwritten = 0
        """How many values were replaced before they were taken."""

    @property
    def waiting(self) -> bool:
        """Whether a value was stored and not taken yet."""
        return self._is_set.is_set()

    def put(self, value: T) -> None:
        """Store a value."""
        self.overwritten += self._is_set.is_set()
        self._value = value
        self._is_set.set()

    def take(self) -> T | None:
        """Return the value and empty the slot; None if the slot is empty. Does not wait."""
        if not self._is_set.is_set():
            return None
        self._is_set.clear()
        value, self._value = self._value, None
        return value

    async def next(self) -> T:
        """Wait for a value and take it."""
        while True:
            await self._is_set.wait()
            value = self.take()
            if value is not None:
                return value


class Ticker:
    """Ticks every `period_s` on the event loop's clock, from the first `wait` on.

    Deadlines are absolute: a late loop skips ticks and counts them in `missed`; it neither bursts nor drifts.
    """

    def __init__(self, period_s: float) -> None:
        if not (math.isfinite(period_s) and period_s > 0):
            raise ValueError(f"period_s is {period_s}; it must be a positive number of seconds")
        self.period_s = period_s
        self.missed = 0
        self._next_s: float | None = None

    async def wait(self, wake: asyncio.Event | None = None) -> bool:
        """Return True at the next tick, or False as soon as `wake` is set (the tick stays due)."""
        loop = asyncio.get_running_loop()
        now_s = loop.time()
        if self._next_s is None:
            self._next_s = now_s + self.period_s
        late = math.floor((now_s - self._next_s) / self.period_s)
        if late > 0:
            self.missed += late
            self._next_s += late * self.period_s
        if wake is None:
            await asyncio.sleep(self._next_s - now_s)
        elif now_s < self._next_s and not wake.is_set():
            handle = loop.call_at(self._next_s, wake.set)
            try:
                await wake.wait()
            finally:
                handle.cancel()
        else:
            await asyncio.sleep(0)
        if loop.time() + 1e-9 < self._next_s:
            return False
        self._next_s += self.period_s
        return True


class Backoff:
    """Pauses between retries: `first_s`, then doubled up to `longest_s` (default: ten times `first_s`)."""

    def __init__(self, first_s: float, longest_s: float | None = None) -> None:
        self._first_s = first_s
        self._longest_s = 10 * first_s if longest_s is None else longest_s
        self._next_s = first_s

    def reset(self) -> None:
        """Start with the first pause again; called after a success."""
        self._next_s = self._first_s

    async def wait(self) -> None:
        """Wait for the next pause."""
        pause_s, self._next_s = self._next_s, min(2 * self._next_s, self._longest_s)
        await asyncio.sleep(pause_s)
