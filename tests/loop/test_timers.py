"""Calls at times of the loop: made once, taken back together, and nothing of them stays."""

from __future__ import annotations

import asyncio
import gc

from slipguard.tools.waiting import wait_until
from slipguard_drivers.timers import TimerGroup


async def test_calls_are_made_at_their_time_and_may_ask_for_more() -> None:
    loop, timers = asyncio.get_running_loop(), TimerGroup()
    begun_s = loop.time()
    made: list[tuple[str, float]] = []

    def first() -> None:
        made.append(("first", loop.time() - begun_s))
        timers.at(begun_s + 0.03, lambda: made.append(("third", loop.time() - begun_s)))

    timers.at(begun_s + 0.02, lambda: made.append(("second", loop.time() - begun_s)))
    timers.at(begun_s + 0.01, first)
    await wait_until(None, lambda: len(made) == 3, 30.0, "not all were made")
    assert [name for name, _ in made] == ["first", "second", "third"]
    assert all(at_s >= 0.01 * k for k, (_, at_s) in enumerate(made, 1))


async def test_what_is_taken_back_is_not_called() -> None:
    loop, timers = asyncio.get_running_loop(), TimerGroup()
    made: list[str] = []
    for name in ("one", "other"):
        timers.at(loop.time() + 0.01, lambda name=name: made.append(name))
    timers.cancel_all()
    timers.at(loop.time() + 0.01, lambda: made.append("new"))
    await asyncio.sleep(0.05)
    assert made == ["new"]


async def test_a_call_that_was_made_leaves_nothing_to_the_garbage_collector() -> None:
    """Every frame of a simulated sensor is held by such a call."""
    loop, timers = asyncio.get_running_loop(), TimerGroup()
    await asyncio.sleep(0)
    gc.collect()
    gc.disable()
    try:
        for _ in range(100):
            timers.at(loop.time(), lambda: None)
            await asyncio.sleep(0)
            await asyncio.sleep(0)
        assert gc.collect() < 50
    finally:
        gc.enable()
