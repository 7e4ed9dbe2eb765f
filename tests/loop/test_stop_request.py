"""A stop request: it comes before everything that waits, and the arm rests within 60 ms, grip and guard unchanged."""

from __future__ import annotations

import asyncio

import pytest
from loop_cell import Cell, play

from slipguard.control.messages import ControlRequest, RequestKind
from slipguard.control.state import Phase
from slipguard.daemon.api.requests import (
    DaemonRequest,
    GraspRequest,
    GuardRequest,
    LiftRequest,
    LowerRequest,
    MoveJawsRequest,
    StopRequest,
)
from slipguard.errors import CommandRefused

WITHIN_S = 0.06


async def lifted(cell: Cell) -> None:
    """Held 40 mm above the table."""
    await cell.grasp()
    await cell.submit(LiftRequest(height_mm=40.0))
    await cell.until(lambda: cell.truth.height_mm > 39.0 and cell.steady())


async def stopped(cell: Cell) -> None:
    """Stop while the arm moves, and check when it rests and that it stays."""
    assert cell.world is not None
    assert cell.world.arm_state(cell.now_s).moving
    asked_s, force_n = cell.now_s, cell.truth.applied_n
    await cell.submit(StopRequest())
    await cell.until(lambda: cell.world is not None and not cell.world.arm_state(cell.now_s).moving)
    assert cell.now_s - asked_s <= WITHIN_S
    height_mm = cell.truth.height_mm
    await asyncio.sleep(5.0)
    assert cell.truth.height_mm == pytest.approx(height_mm, abs=0.01)
    assert cell.truth.applied_n >= force_n
    assert cell.handlers.snapshot().stopped_by_request is True


def test_it_ends_a_lift_and_a_lowering_and_both_go_on_from_there() -> None:
    async def scene(cell: Cell) -> None:
        await cell.grasp()
        await cell.submit(LiftRequest(height_mm=80.0))
        await cell.until(lambda: cell.truth.height_mm > 30.0)
        await stopped(cell)
        assert cell.phase is Phase.HOLDING
        await cell.submit(LowerRequest())
        assert cell.handlers.snapshot().stopped_by_request is False
        await cell.until(lambda: cell.truth.height_mm < 25.0)
        await stopped(cell)
        await cell.submit(LiftRequest(height_mm=20.0))
        await cell.until(lambda: cell.phase is Phase.HOLDING)
        await cell.release()

    play(Cell("bar", 3, guard={"first_force_n": 90.0}), scene)


def test_it_pauses_the_program_that_moves_the_arm_in_guard_mode() -> None:
    async def scene(cell: Cell) -> None:
        assert cell.world is not None
        await cell.ready()
        await cell.submit(MoveJawsRequest(width_mm=0.0, force_n=90.0))
        await cell.until(lambda: cell.phase is Phase.HOLDING)
        cell.world.command_lift(cell.now_s, 80.0, 40.0)
        await asyncio.sleep(0.5)
        await stopped(cell)
        cell.world.command_lift(cell.now_s, 20.0, 40.0)  # started again, by a person at the robot
        await asyncio.sleep(1.0)
        assert cell.truth.height_mm > 30.0
        assert cell.handlers.snapshot().stopped_by_request is False

    play(Cell("bar", 3, guard={"mode": "guard", "stop_on_slip": False}), scene)


def test_a_slip_after_it_is_met_with_force() -> None:
    async def scene(cell: Cell) -> None:
        await cell.grasp()
        await cell.submit(LiftRequest())
        await cell.until(lambda: cell.truth.height_mm > 20.0)
        await stopped(cell)
        first_n = cell.truth.applied_n
        cell.world.add_mass(cell.now_s, 3.0)
        await asyncio.sleep(1.0)
        assert cell.truth.applied_n > first_n
        assert cell.truth.dropped is None

    play(Cell("wrench", 1), scene)


def test_closing_jaws_are_halted() -> None:
    async def scene(cell: Cell) -> None:
        await cell.ready()
        await cell.submit(GraspRequest())
        await asyncio.sleep(0.1)
        assert "the closing was interrupted" in await cell.submit(StopRequest())
        await asyncio.sleep(WITHIN_S)
        width_mm = cell.width_mm
        await asyncio.sleep(5.0)
        assert cell.width_mm == pytest.approx(width_mm, abs=0.1)
        assert not cell.truth.in_contact
        await cell.grasp()

    play(Cell(), scene)


@pytest.mark.parametrize(
    "waiting",
    [LiftRequest(), LowerRequest(height_mm=5.0), GuardRequest(on=False), MoveJawsRequest(force_n=60.0)],
    ids=lambda request: request.kind,
)
def test_requests_that_wait_do_not_delay_it_and_are_refused(waiting: DaemonRequest) -> None:
    async def scene(cell: Cell) -> None:
        await lifted(cell)
        before = len(cell.arm.commands)
        queue = [asyncio.create_task(cell.submit(waiting)) for _ in range(50)]
        await asyncio.sleep(0)
        asked_s = cell.now_s
        assert (await cell.submit(StopRequest())).startswith("stopped by request")
        assert cell.now_s - asked_s < 0.02, "one cycle of the loop"
        answers = await asyncio.gather(*queue, return_exceptions=True)
        assert {type(answer) for answer in answers} == {CommandRefused}
        assert str(answers[-1]).endswith("a stop was requested after it; not executed")
        await asyncio.sleep(1.0)
        assert {what for _, what, _ in cell.arm.commands[before:]} <= {"stop"}
        assert cell.service.state.guarding

    play(Cell("bar", 3, guard={"first_force_n": 90.0}), scene)


def test_a_release_that_waits_is_kept_and_comes_after_it() -> None:
    async def scene(cell: Cell) -> None:
        await lifted(cell)
        order = list[str]()

        async def ask(kind: RequestKind) -> None:
            await cell.service.request(ControlRequest(kind))
            order.append(kind.value)

        kinds = (RequestKind.LIFT, RequestKind.RELEASE, RequestKind.STOP, RequestKind.STOP)
        outcomes = await asyncio.gather(*map(ask, kinds), return_exceptions=True)
        assert [type(outcome) for outcome in outcomes] == [CommandRefused, type(None), type(None), type(None)]
        assert order == ["stop", "stop", "release"]
        await cell.until(lambda: cell.phase is Phase.IDLE)
        assert cell.width_mm == pytest.approx(85.0, abs=0.5)

    play(Cell("bar", 3, guard={"first_force_n": 90.0}), scene)
