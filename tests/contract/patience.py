"""Waiting for what a device does in its own time."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import TypeVar

T = TypeVar("T")
PATIENCE_S = 3.0


async def eventually(question: Callable[[], Awaitable[T]], good: Callable[[T], object]) -> T:
    """Ask until the answer is as it should be; fails with the last answer after three seconds."""
    loop = asyncio.get_running_loop()
    ends_s = loop.time() + PATIENCE_S
    while not good(answer := await question()):
        assert loop.time() < ends_s, f"still {answer}"
        await asyncio.sleep(0.01)
    return answer
