"""A beat with absolute deadlines: a late loop skips and counts, it never bursts and never drifts."""

from __future__ import annotations

import asyncio
import math


class Ticker:
    """Beats every `period_s` from its first `wait`, on the event loop's clock.

    missed: how many beats passed while nobody waited for them.
    """

    def __init__(self, period_s: float) -> None:
        if not (math.isfinite(period_s) and period_s > 0):
            raise ValueError(f"period_s is {period_s}; it must be a positive number of seconds")
        self.period_s = period_s
        self.missed = 0
        self._next_s: float | None = None

    async def wait(self, wake: asyncio.Event | None = None) -> bool:
        """Return True at the next beat, or False as soon as `wake` is set (the beat stays due)."""
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
