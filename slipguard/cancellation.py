"""A task that was told to end, and ends."""

from __future__ import annotations

import asyncio


def raise_if_cancelled() -> None:
    """Raise CancelledError where this task was cancelled and whatever it awaited has swallowed that.

    For loops that go on whatever a driver or a library raises. Until Python 3.12 `asyncio.wait_for`, which pymodbus
    wraps around every attempt and every question, swallows a cancellation that meets its answer; and an error raised
    while cleaning up takes its place.
    """
    task = asyncio.current_task()
    if task is not None and task.cancelling():
        raise asyncio.CancelledError
