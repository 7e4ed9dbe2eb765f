"""The parts of the loop on virtual time: cycle, latest value, worker and clock."""

from __future__ import annotations

import asyncio

import pytest

from slipguard.daemon.loop.async_tools import Backoff, LatestValue, Ticker
from slipguard.daemon.loop.virtual_time import run_virtual
from slipguard.daemon.loop.worker import FixedLatencyWorker, ThreadWorker


def test_thirty_thousand_ticks_neither_drift_nor_miss() -> None:
    async def scenario() -> tuple[int, int]:
        ticker, loop = Ticker(0.01), asyncio.get_running_loop()
        end_s, ticks = loop.time() + 300.0, 0
        while loop.time() < end_s - 1e-6:
            await ticker.wait()
            await asyncio.sleep(0.004)  # the work of a tick
            ticks += 1
        return ticks, ticker.missed

    assert run_virtual(scenario()) == (30_000, 0)


def test_a_late_loop_skips_and_counts_and_does_not_burst() -> None:
    async def scenario() -> tuple[int, list[float]]:
        ticker, loop = Ticker(0.01), asyncio.get_running_loop()
        await ticker.wait()
        await asyncio.sleep(0.055)
        times = []
        for _ in range(3):
            await ticker.wait()
            times.append(round(loop.time() % 1, 6))
        return ticker.missed, times

    missed, times = run_virtual(scenario())
    assert missed == 4
    assert times == [
        0.065,
        0.07,
        0.08,
    ]  # one beat at once for the one now due, then on the grid again


def test_a_new_value_wakes_before_the_next_tick() -> None:
    async def scenario() -> tuple[bool, bool, float]:
        ticker, wake, loop = Ticker(0.01), asyncio.Event(), asyncio.get_running_loop()
        start_s = loop.time()
        loop.call_later(0.003, wake.set)
        first = await ticker.wait(wake)
        wake.clear()
        second = await ticker.wait(wake)
        return first, second, loop.time() - start_s

    first, second, elapsed_s = run_virtual(scenario())
    assert (first, second) == (False, True)
    assert elapsed_s == pytest.approx(0.01)


@pytest.mark.parametrize("period_s", [0.0, -1.0, float("nan"), float("inf")])
def test_a_period_must_be_a_positive_time(period_s: float) -> None:
    with pytest.raises(ValueError, match="period_s"):
        Ticker(period_s)


async def test_only_the_newest_value_is_taken() -> None:
    slot: LatestValue[int] = LatestValue()
    assert slot.take() is None
    for value in (1, 2, 3):
        slot.put(value)
    assert await slot.next() == 3
    assert slot.take() is None
    assert slot.overwritten == 2


async def test_a_thread_worker_leaves_the_loop_free_and_passes_errors_on() -> None:
    worker = ThreadWorker("test")
    gate = asyncio.Event()
    loop = asyncio.get_running_loop()

    def work(value: int) -> int:
        loop.call_soon_threadsafe(gate.set)
        return 10 // value

    running = asyncio.create_task(worker.run(work, 5))
    await gate.wait()
    assert await running == 2
    with pytest.raises(ZeroDivisionError):
        await worker.run(work, 0)
    worker.close()


def test_stated_latency_passes_on_the_virtual_clock() -> None:
    async def scenario() -> tuple[int, float]:
        loop = asyncio.get_running_loop()
        start_s = loop.time()
        result = await FixedLatencyWorker(0.006).run(lambda value: value + 1, 1)
        return result, loop.time() - start_s

    result, elapsed_s = run_virtual(scenario())
    assert result == 2
    assert elapsed_s == pytest.approx(0.006)


def test_back_off_doubles_up_to_ten_times_and_starts_again() -> None:
    async def scenario() -> list[float]:
        backoff, loop, pauses = Backoff(0.5), asyncio.get_running_loop(), []
        for _ in range(6):
            start_s = loop.time()
            await backoff.wait()
            pauses.append(loop.time() - start_s)
        backoff.reset()
        start_s = loop.time()
        await backoff.wait()
        return [*pauses, loop.time() - start_s]

    assert run_virtual(scenario()) == pytest.approx([0.5, 1, 2, 4, 5, 5, 0.5])


def test_virtual_time_raises_what_an_executor_raises() -> None:
    async def scenario() -> None:
        loop = asyncio.get_running_loop()
        assert await loop.run_in_executor(None, len, "abc") == 3
        with pytest.raises(ValueError, match="no"):
            await loop.run_in_executor(None, _refuse)

    def _refuse() -> None:
        raise ValueError("no")

    run_virtual(scenario())
