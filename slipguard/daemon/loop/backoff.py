"""How long to wait before a missing device is tried again."""

from __future__ import annotations

import asyncio


class Backoff:
    """Pauses of `first_s`, doubling up to `longest_s` (None: ten times that); `reset` after a success."""

    def __init__(self, first_s: float, longest_s: float | None = None) -> None:
        self._first_s = first_s
        self._longest_s = 10 * first_s if longest_s is None else longest_s
        self._next_s = first_s

    def reset(self) -> None:
        """The device is well: begin with the first pause again."""
        self._next_s = self._first_s

    async def wait(self) -> None:
        """Wait the next pause."""
        pause_s, self._next_s = self._next_s, min(2 * self._next_s, self._longest_s)
        await asyncio.sleep(pause_s)
