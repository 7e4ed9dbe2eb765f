"""Run a service for a while, and wait for its states."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager

from slipguard.daemon.loop.service import Service
from slipguard.errors import SlipguardError

POLL_S = 0.01


class WaitTimeout(SlipguardError):
    """An expected state was not reached in time."""


@asynccontextmanager
async def running_service(service: Service) -> AsyncIterator[asyncio.Task[None]]:
    """Run a service during the block; yields its task."""
    running = asyncio.create_task(service.run(), name="service")
    try:
        yield running
    finally:
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)


async def wait_until(
    running: asyncio.Task[None] | None,
    reached: Callable[[], bool],
    timeout_s: float,
    otherwise: str | Callable[[], str],
    poll_s: float = POLL_S,
) -> None:
    """Wait until a condition holds, checked every `poll_s`.

    Args:
        running: The daemon's task; None if its failures are handled elsewhere.
        otherwise: Describes the state if the condition is not reached.

    Raises:
        WaitTimeout: After the timeout, or if the daemon has ended. A failure of the daemon is raised as it is.
    """
    loop = asyncio.get_running_loop()
    deadline_s = loop.time() + timeout_s
    while not reached():
        if running is not None and running.done():
            running.result()
            raise WaitTimeout("the daemon ended unexpectedly. Check its log")
        if loop.time() >= deadline_s:
            raise WaitTimeout(f"after {timeout_s:g} s: {otherwise if isinstance(otherwise, str) else otherwise()}")
        await asyncio.sleep(poll_s)
