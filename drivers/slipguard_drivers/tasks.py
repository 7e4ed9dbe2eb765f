"""Ending the tasks that drivers and doubles keep running beside their calls."""

from __future__ import annotations

import asyncio


async def ended(task: asyncio.Task[None] | None) -> None:
    """Cancel a task and wait for its end; raises what it raised. None: there is nothing to end.

    Who waits here may be cancelled, too, and learns of it.
    """
    if task is None:
        return
    task.cancel()
    await asyncio.wait([task])
    if not task.cancelled():
        task.result()
