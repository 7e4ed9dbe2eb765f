"""Waiting for what a device does in its own time."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import TypeVar

from slipguard.errors import DeviceTimeout

T = TypeVar("T")
PATIENCE_S = 3.0


async def eventually(question: Callable[[], Awaitable[T]], good: Callable[[T], object]) -> T:
    """Ask until the answer is as it should be; fails with the last answer after three seconds.

    A time-out means: ask again.
    """
    loop = asyncio.get_running_loop()
    ends_s = loop.time() + PATIENCE_S
    while True:
        try:
            if good(answer := await question()):
                return answer
            last: object = answer
        except DeviceTimeout as error:
            last = error
        assert loop.time() < ends_s, f"still {last}"
        await asyncio.sleep(0.01)


async def answer_of(question: Callable[[], Awaitable[T]]) -> T:
    """The first answer that comes in time."""
    return await eventually(question, lambda answer: True)
