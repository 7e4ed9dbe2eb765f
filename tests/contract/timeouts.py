"""Wait for a device to reach a state."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import TypeVar

from slipguard.errors import DeviceTimeout

T = TypeVar("T")
TIMEOUT_S = 3.0


async def eventually(read: Callable[[], Awaitable[T]], condition: Callable[[T], object]) -> T:
    """Read until the condition holds, and return that value; fail with the last value after three seconds.

    A DeviceTimeout is read again.
    """
    loop = asyncio.get_running_loop()
    ends_s = loop.time() + TIMEOUT_S
    while True:
        try:
            if condition(value := await read()):
                return value
            last: object = value
        except DeviceTimeout as error:
            last = error
        assert loop.time() < ends_s, f"still {last}"
        await asyncio.sleep(0.01)


async def first_value(read: Callable[[], Awaitable[T]]) -> T:
    """Return the first value that is read without a time-out."""
    return await eventually(read, lambda value: True)
