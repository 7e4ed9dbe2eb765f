"""A busy or suspended machine is reported as such, not as broken cameras; the grip stays and `clear` works."""

from __future__ import annotations

import asyncio
import contextlib
import threading

import pytest
from loop_cell import Cell, play

from slipguard.control.reports import FaultCode
from slipguard.control.state import Phase
from slipguard.daemon.api.requests import ClearRequest, LiftRequest
from slipguard.daemon.loop.virtual_time import VirtualTimeLoop
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
def test_a_suspended_process_latches_the_true_reason_and_goes_on(lifting: bool) -> None:
    async def scene(cell: Cell) -> None:
        await cell.grasp()
        if lifting:
            await cell.submit(LiftRequest())
            await asyncio.sleep(0.2)
        stand_still(6.0)
        await cell.until(lambda: cell.phase is Phase.FAULT, 0.1)
        fault = cell.service.state.fault
        assert fault is not None
        assert fault.code is FaultCode.LOOP_LATE
        assert "no control step for 6.0" in fault.observed
        await asyncio.sleep(0.5)
        await held_and_cleared(cell)

    play(Cell("wrench", 1), scene)


def test_a_suspended_process_that_holds_nothing_reports_the_gap() -> None:
    async def scene(cell: Cell) -> None:
        await cell.ready()
        stand_still(6.0)
        await asyncio.sleep(0.5)
        assert any("no control step for 6.0" in line for line in cell.service.event_log.lines)
        assert cell.phase is Phase.IDLE
        await cell.grasp()

    play(Cell("wrench", 1), scene)


def test_a_loop_that_is_late_again_and_again_is_named() -> None:
    """Four fifths of the time go to other programs; the cameras' frames are lost on the way."""

    async def scene(cell: Cell) -> None:
        assert cell.world is not None
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

    play(Cell("wrench", 1), scene)


@pytest.mark.parametrize("device", ["gripper", "arm"])
@pytest.mark.parametrize("busy", [True, False])
def test_a_silent_device_is_not_blamed_alone_if_the_loop_was_late(device: str, busy: bool) -> None:
    async def scene(cell: Cell) -> None:
        assert cell.world is not None
        await cell.ready()
        cell.world.faults.fail(device, "timeout")
        for _ in range(100):
            await asyncio.sleep(PERIOD_S)
            stand_still(4 * PERIOD_S * busy)
        (line,) = (line for line in cell.service.event_log.lines if line.startswith(f"{device}: "))
        assert ("this machine is too busy (the control loop was late for 0." in line) is busy
        reason = cell.service.devices[device].health.reason
        assert ("this machine is too busy" in reason) is busy

    play(Cell("wrench", 1), scene)


def test_workers_that_are_late_are_named() -> None:
    async def scene(cell: Cell) -> None:
        await cell.grasp()
        for worker in cell.workers.values():
            worker.latency_s = 0.5
        await cell.until(lambda: cell.phase is Phase.FAULT, 1.0)
        fault = cell.service.state.fault
        assert fault is not None
        assert fault.code is FaultCode.MACHINE_BUSY
        assert "frames arrive, but are processed" in fault.observed
        for worker in cell.workers.values():
            worker.latency_s = 0.006
        await asyncio.sleep(1.0)
        await held_and_cleared(cell)

    play(Cell("wrench", 1), scene)


def test_processing_that_never_returns_is_named() -> None:
    async def scene(cell: Cell) -> None:
        await cell.grasp()
        for worker in cell.workers.values():
            worker.latency_s = 1e6
            worker.waited_s = lambda: 3.0  # type: ignore[method-assign]
        await cell.until(lambda: cell.phase is Phase.FAULT, 1.0)
        fault = cell.service.state.fault
        assert fault is not None
        assert fault.code is FaultCode.FRAMES_LOST
        assert (
            "frames arrive, but their processing does not return (left: the processing of a frame has" in fault.observed
        )
        assert "restart slipguard" in fault.what_to_do
        await asyncio.sleep(1.0)
        lines = "\n".join(cell.service.event_log.lines)
        assert "left: the processing of a frame has not returned for " in lines
        assert "busy" not in lines

    play(Cell("wrench", 1), scene)


def test_a_thread_that_waits_for_a_processor_is_not_stuck() -> None:
    async def scene(cell: Cell) -> None:
        await cell.grasp()
        for worker in cell.workers.values():
            worker.latency_s = 1e6
            worker.waited_s = lambda: 0.5 * cell.now_s  # type: ignore[method-assign]
        await cell.until(lambda: cell.phase is Phase.FAULT, 1.0)
        fault = cell.service.state.fault
        assert fault is not None
        assert fault.code is FaultCode.MACHINE_BUSY

    play(Cell("wrench", 1), scene)


def test_a_thread_that_hangs_does_not_wait_for_a_processor() -> None:
    async def main() -> None:
        worker, hangs, goes_on = ThreadWorker("test"), threading.Event(), threading.Event()

        def hang(_: object) -> bool:
            hangs.set()
            return goes_on.wait()

        task = asyncio.create_task(worker.run(hang, None))
        await asyncio.to_thread(hangs.wait)
        await asyncio.sleep(0.02)
        waited_s = worker.waited_s()
        await asyncio.sleep(0.05)
        assert waited_s is not None
        assert worker.waited_s() == waited_s
        goes_on.set()
        await task
        worker.close()

    asyncio.run(main())


def test_frames_with_an_old_stamp_are_named_after_their_clock() -> None:
    async def scene(cell: Cell) -> None:
        assert cell.world is not None
        await cell.grasp()
        for name in ("left", "right"):
            cell.world.faults.fail(name, "stamps_behind")
        await cell.until(lambda: cell.phase is Phase.FAULT, 1.0)
        fault = cell.service.state.fault
        assert fault is not None
        assert fault.code is FaultCode.FRAMES_LOST
        assert "left: its frames are stamped 5.0" in fault.observed
        await asyncio.sleep(0.5)
        lines = "\n".join(cell.service.event_log.lines)
        assert "s before they arrive: the camera's clock is wrong" in lines
        assert "busy" not in lines

    play(Cell("wrench", 1), scene)


def test_cameras_that_stall_on_an_idle_machine_are_named() -> None:
    async def scene(cell: Cell) -> None:
        assert cell.world is not None
        await cell.grasp()
        stand_still(0.2)
        await asyncio.sleep(2.0)
        for name in ("left", "right"):
            cell.world.faults.fail(name, "stall")
        await cell.until(lambda: cell.phase is Phase.FAULT, 1.0)
        fault = cell.service.state.fault
        assert fault is not None
        assert fault.code is FaultCode.FRAMES_LOST

    play(Cell("wrench", 1), scene)
