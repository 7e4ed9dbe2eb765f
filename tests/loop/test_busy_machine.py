"""A busy or suspended machine is reported as such, not as broken cameras; cycles are skipped and counted."""

from __future__ import annotations

import asyncio
import contextlib
import threading

import numpy as np
import pytest
from loop_cell import Cell, on_cell

from slipguard.control.reports import FaultCode
from slipguard.control.state import Phase
from slipguard.daemon.api.requests import ClearRequest, LiftRequest
from slipguard.daemon.loop.async_tools import Backoff, Ticker
from slipguard.daemon.loop.virtual_time import VirtualTimeLoop, run_virtual
from slipguard.daemon.loop.worker import ThreadWorker
from slipguard.errors import CommandRefused

PERIOD_S = 0.01


def stand_still(for_s: float) -> None:
    """Nothing of this process runs for this time; the world goes on."""
    loop = asyncio.get_running_loop()
    assert isinstance(loop, VirtualTimeLoop)
    loop.stand_still(for_s)


async def clear_when_possible(cell: Cell) -> None:
    for _ in range(50):
        with contextlib.suppress(CommandRefused):
            await cell.submit(ClearRequest())
            return
        await asyncio.sleep(0.1)
    raise AssertionError(cell.summary)


DEVICE_FAULTS = (FaultCode.FRAMES_LOST, FaultCode.GRIPPER_SILENT, FaultCode.ARM_SILENT)


async def held_and_cleared(cell: Cell) -> None:
    blamed = [line for line in cell.service.event_log.lines if line.startswith(DEVICE_FAULTS)]
    assert not blamed, "no device is at fault"
    assert cell.truth.dropped is None
    await clear_when_possible(cell)
    await cell.until(cell.steady)


@pytest.mark.parametrize("lifting", [False, True])
@on_cell("wrench", 1)
async def test_a_suspended_process_latches_the_true_reason_and_goes_on(cell: Cell, lifting: bool) -> None:
    await cell.grasp()
    if lifting:
        await cell.submit(LiftRequest())
        await asyncio.sleep(0.2)
    stand_still(6.0)
    fault = await cell.faulted(FaultCode.LOOP_LATE, 0.1)
    assert "no control step for 6.0" in fault.observed
    await asyncio.sleep(0.5)
    await held_and_cleared(cell)


@on_cell("wrench", 1)
async def test_a_loop_that_is_late_again_and_again_is_named(cell: Cell) -> None:
    """Four fifths of the time go to other programs; the cameras' frames are lost on the way."""
    await cell.grasp()
    for name in ("left", "right"):
        cell.world.faults.fail(name, "stall")
    while cell.phase is not Phase.FAULT:
        await asyncio.sleep(PERIOD_S)
        stand_still(4 * PERIOD_S)
    assert cell.service.deadlines_missed > 10
    fault = cell.service.state.fault
    assert fault is not None
    assert fault.code is FaultCode.MACHINE_BUSY
    assert "frames lost: no good frame" in fault.observed
    for name in ("left", "right"):
        cell.world.faults.repair(name)
    await cell.ready()
    await held_and_cleared(cell)


@pytest.mark.parametrize("device", ["gripper", "arm"])
@pytest.mark.parametrize("busy", [True, False])
@on_cell("wrench", 1)
async def test_a_silent_device_is_not_blamed_alone_if_the_loop_was_late(cell: Cell, device: str, busy: bool) -> None:
    await cell.ready()
    cell.world.faults.fail(device, "timeout")
    for _ in range(100):
        await asyncio.sleep(PERIOD_S)
        stand_still(4 * PERIOD_S * busy)
    (line,) = (line for line in cell.service.event_log.lines if line.startswith(f"{device}: "))
    assert ("this machine is too busy (the control loop was late for 0." in line) is busy
    reason = cell.service.devices[device].health.reason
    assert ("this machine is too busy" in reason) is busy


@on_cell("wrench", 1)
async def test_processing_that_never_returns_is_named(cell: Cell) -> None:
    await cell.grasp()
    for worker in cell.workers.values():
        worker.latency_s = 1e6
        worker.waited_s = lambda: 3.0  # type: ignore[method-assign]
    fault = await cell.faulted(FaultCode.FRAMES_LOST, 1.0)
    assert "frames arrive, but their processing does not return (left: the processing of a frame has" in fault.observed
    assert "restart slipguard" in fault.what_to_do
    await asyncio.sleep(1.0)
    lines = "\n".join(cell.service.event_log.lines)
    assert "left: the processing of a frame has not returned for " in lines
    assert "busy" not in lines


@on_cell(latency_s=0.05)
async def test_the_newest_frame_wins_when_the_worker_is_slow(cell: Cell) -> None:
    await cell.ready()
    judged: dict[str, list[int]] = {"left": [], "right": []}
    cell.service.observers.append(
        lambda decision: [judged[name].append(one.sequence) for name, one in decision.new_estimates.items()]
    )
    await asyncio.sleep(2.0)
    for name, finger in cell.service.fingers.items():
        steps = np.diff(judged[name])
        assert (steps >= 3).all()  # 50 ms of work, a frame every 16.7 ms
        assert (steps <= 5).all()
        assert finger.capture.counts.late > 50
        assert finger.captured_at_s is not None
        assert cell.now_s - finger.captured_at_s < 0.17


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


@pytest.mark.parametrize(("latency_s", "waited_share"), [(0.5, None), (1e6, 0.5)], ids=["late", "without a processor"])
@on_cell("wrench", 1)
async def test_late_processing_is_named_after_the_machine(
    cell: Cell, latency_s: float, waited_share: float | None
) -> None:
    await cell.grasp()
    for worker in cell.workers.values():
        worker.latency_s = latency_s
        worker.waited_s = lambda: waited_share and waited_share * cell.now_s  # type: ignore[method-assign]
    fault = await cell.faulted(FaultCode.MACHINE_BUSY, 1.0)
    assert "frames arrive, but are processed" in fault.observed


async def test_a_thread_that_hangs_does_not_wait_for_a_processor() -> None:
    worker, hangs, goes_on = ThreadWorker("test"), threading.Event(), threading.Event()

    def hang(_: object) -> bool:
        hangs.set()
        return goes_on.wait()

    task = asyncio.create_task(worker.run(hang, None))
    await asyncio.to_thread(hangs.wait)
    await asyncio.sleep(0.02)
    before_s = worker.waited_s()
    await asyncio.sleep(0.05)
    after_s = worker.waited_s()
    goes_on.set()
    await task
    worker.close()
    assert after_s == before_s is not None


@on_cell("wrench", 1)
async def test_cameras_that_stall_after_the_machine_was_busy_are_named(cell: Cell) -> None:
    await cell.grasp()
    stand_still(0.2)
    await asyncio.sleep(2.0)
    for name in ("left", "right"):
        cell.world.faults.fail(name, "stall")
    await cell.faulted(FaultCode.FRAMES_LOST, 1.0)
