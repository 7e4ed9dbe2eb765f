"""Waiting for a running service to get somewhere."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from slipguard.errors import SlipguardError


async def until(running: asyncio.Task[None], reached: Callable[[], bool], timeout_s: float, otherwise: str) -> None:
    """Wait for a condition; the daemon's own failure, or the time-out, is raised."""
    loop = asyncio.get_running_loop()
    deadline_s = loop.time() + timeout_s
    while not reached():
        if running.done():
            running.result()
            raise SlipguardError("the daemon ended by itself")
        if loop.time() >= deadline_s:
            raise SlipguardError(f"{otherwise} within {timeout_s:g} s")
        await asyncio.sleep(0.01)
