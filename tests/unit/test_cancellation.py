"""`slipguard.cancellation`: tasks that are cancelled have ended, and cancelled timers do not fire."""

from __future__ import annotations

import asyncio

import pytest

from slipguard.cancellation import TimerGroup, cancel_and_wait
from slipguard.tools.waiting import wait_until


async def _slow_to_end(over: list[bool]) -> None:
    try:
        await asyncio.sleep(60.0)
    finally:
        await asyncio.sleep(0.01)
        over.append(True)


async def test_the_task_has_ended_when_it_returns() -> None:
    over: list[bool] = []
    task = asyncio.create_task(_slow_to_end(over))
    await asyncio.sleep(0)
    await cancel_and_wait(task)
    assert over == [True]
    await cancel_and_wait(task)
    await cancel_and_wait(None)


async def test_a_cancelled_caller_gets_the_cancellation() -> None:
    over: list[bool] = []
    task = asyncio.create_task(_slow_to_end(over))
    await asyncio.sleep(0)
    waiting = asyncio.create_task(cancel_and_wait(task))
    await asyncio.sleep(0)
    waiting.cancel()
    with pytest.raises(asyncio.CancelledError):
        await waiting
    await asyncio.wait([task])
    assert over == [True]


async def test_timers_fire_at_their_time_and_may_start_more() -> None:
    loop, timers = asyncio.get_running_loop(), TimerGroup()
    begun_s = loop.time()
    made: list[tuple[str, float]] = []

    def first() -> None:
        made.append(("first", loop.time() - begun_s))
        timers.call_at(begun_s + 0.03, lambda: made.append(("third", loop.time() - begun_s)))

    timers.call_at(begun_s + 0.02, lambda: made.append(("second", loop.time() - begun_s)))
    timers.call_at(begun_s + 0.01, first)
    await wait_until(None, lambda: len(made) == 3, 30.0, "not all timers fired")
    assert [name for name, _ in made] == ["first", "second", "third"]
    assert all(at_s >= 0.01 * k for k, (_, at_s) in enumerate(made, 1))


async def test_cancelled_timers_do_not_fire() -> None:
    loop, timers = asyncio.get_running_loop(), TimerGroup()
    made: list[str] = []
    for name in ("one", "other"):
        timers.call_at(loop.time() + 0.01, lambda name=name: made.append(name))
    timers.cancel_all()
    timers.call_at(loop.time() + 0.01, lambda: made.append("new"))
    await asyncio.sleep(0.05)
    assert made == ["new"]
