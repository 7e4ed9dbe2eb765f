"""Ending a task beside a driver: it is over when that returns, its failure is told, and so is one's own cancelling."""

from __future__ import annotations

import asyncio

import pytest

from slipguard_drivers.tasks import ended


async def _slow_to_end(over: list[bool]) -> None:
    try:
        await asyncio.sleep(60.0)
    finally:
        await asyncio.sleep(0.01)
        over.append(True)


async def _fails() -> None:
    raise ZeroDivisionError


async def test_it_is_over_when_this_returns() -> None:
    over: list[bool] = []
    task = asyncio.create_task(_slow_to_end(over))
    await asyncio.sleep(0)
    await ended(task)
    assert over == [True]
    await ended(task)
    await ended(None)


async def test_its_failure_is_told() -> None:
    task = asyncio.create_task(_fails())
    await asyncio.sleep(0)
    with pytest.raises(ZeroDivisionError):
        await ended(task)


async def test_who_waits_and_is_cancelled_learns_of_it() -> None:
    over: list[bool] = []
    task = asyncio.create_task(_slow_to_end(over))
    await asyncio.sleep(0)
    waiting = asyncio.create_task(ended(task))
    await asyncio.sleep(0)
    waiting.cancel()
    with pytest.raises(asyncio.CancelledError):
        await waiting
    await asyncio.wait([task])
    assert over == [True]
