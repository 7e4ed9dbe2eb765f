"""Waiting for a running service to get somewhere."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from slipguard.errors import SlipguardError

POLL_S = 0.01


class WaitTimeout(SlipguardError):
    """Something does not come to its end: nothing more is worth trying."""


async def wait_until(
    running: asyncio.Task[None] | None,
    reached: Callable[[], bool],
    timeout_s: float,
    otherwise: str | Callable[[], str],
    poll_s: float = POLL_S,
) -> None:
    """Wait for a condition, looked at every `poll_s`. Raises the daemon's own failure, or Stuck after the time-out.

    running: the daemon's task; None where somebody else watches it. otherwise: what is so if it is not reached.
    """
    loop = asyncio.get_running_loop()
    deadline_s = loop.time() + timeout_s
    while not reached():
        if running is not None and running.done():
            running.result()
            raise WaitTimeout("the daemon ended by itself")
        if loop.time() >= deadline_s:
            raise WaitTimeout(f"within {timeout_s:g} s: {otherwise if isinstance(otherwise, str) else otherwise()}")
        await asyncio.sleep(poll_s)
