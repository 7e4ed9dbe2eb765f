"""A stop of the arm, by request or near a person: it comes first, and no force is added while a hand may be there."""

from __future__ import annotations

import asyncio

import pytest
from loop_cell import Cell, on_cell

from slipguard.control.messages import ControlRequest, RequestKind
from slipguard.control.state import Phase
from slipguard.daemon.api.requests import (
    ClearRequest,
    DaemonRequest,
    GraspRequest,
    GuardRequest,
    LiftRequest,
    LowerRequest,
    MoveJawsRequest,
    ReleaseRequest,
    StopRequest,
)
from slipguard.errors import CommandRefused, DeviceTimeout

WITHIN_S = 0.06


async def lifted(cell: Cell) -> None:
    """Held 40 mm above the table."""
    await cell.grasp()
    await cell.submit(LiftRequest(height_mm=40.0))
    await cell.until(lambda: cell.truth.height_mm > 39.0 and cell.steady())


async def stopped(cell: Cell) -> None:
    """Stop while the arm moves, and check when it rests and that it stays."""
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


@on_cell("bar", 3, guard={"first_force_n": 90.0})
async def test_it_ends_a_lift_and_a_lowering_and_both_go_on_from_there(cell: Cell) -> None:
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


@on_cell("bar", 3, guard={"mode": "guard", "stop_on_slip": False})
async def test_it_pauses_the_program_that_moves_the_arm_in_guard_mode(cell: Cell) -> None:
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


@on_cell()
async def test_closing_jaws_are_halted(cell: Cell) -> None:
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


@pytest.mark.parametrize(
    "waiting",
    [LiftRequest(), LowerRequest(height_mm=5.0), GuardRequest(on=False), MoveJawsRequest(force_n=60.0)],
    ids=lambda request: request.kind,
)
@on_cell("bar", 3, guard={"first_force_n": 90.0})
async def test_requests_that_wait_do_not_delay_it_and_are_refused(cell: Cell, waiting: DaemonRequest) -> None:
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


@on_cell("bar", 3, guard={"first_force_n": 90.0})
async def test_a_release_that_waits_is_kept_and_comes_after_it(cell: Cell) -> None:
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


BRISK = {"lift_speed_mm_s": 100.0, "tuning": {"lower_speed_mm_s": 60.0}}
STOPS = ["protective_stop", "emergency_stop"]


@pytest.mark.parametrize("stop", STOPS)
@pytest.mark.parametrize("lost", [0, 1])
@on_cell("wrench", 1)
async def test_jaws_on_their_way_stand_and_close_only_when_asked_again(cell: Cell, stop: str, lost: int) -> None:
    await cell.ready()
    await cell.submit(GraspRequest())
    await asyncio.sleep(0.05)
    cell.world.faults.fail("arm", stop)
    cell.gripper.failures = [DeviceTimeout("gripper: no answer within 50 ms")] * lost
    await asyncio.sleep(0.15 + 0.15 * lost)
    width_mm = cell.width_mm
    assert cell.truth.force_n == 0.0
    await asyncio.sleep(3.0)
    assert cell.width_mm == width_mm
    assert [what for _, what, _ in cell.gripper.commands] == ["hold", *["halt"] * (1 + lost)]
    cell.world.faults.repair("arm", stop)
    await asyncio.sleep(0.3)
    await cell.submit(ClearRequest())
    await asyncio.sleep(0.5)
    assert (cell.width_mm, cell.phase) == (width_mm, Phase.IDLE)
    await cell.grasp()
    await cell.until(lambda: cell.phase is Phase.HOLDING)


@pytest.mark.parametrize("stop", STOPS)
@on_cell("wrench", 1)
async def test_a_force_that_rises_stays_where_it_is_until_clear(cell: Cell, stop: str) -> None:
    await cell.grasp()
    before_n = cell.truth.force_n
    await cell.submit(MoveJawsRequest(width_mm=0.0, force_n=120.0))
    await cell.until(lambda: cell.truth.force_n > before_n + 1.0)
    cell.world.faults.fail("arm", stop)
    await asyncio.sleep(0.1)
    halted_n = cell.truth.force_n
    assert halted_n < 110.0
    await asyncio.sleep(2.0)
    assert cell.truth.force_n == halted_n
    cell.world.faults.repair("arm", stop)
    await asyncio.sleep(2.0)
    assert cell.truth.force_n == halted_n, "a hand may still be there"
    await cell.submit(ClearRequest())
    await cell.until(lambda: cell.truth.force_n > 110.0)
    await cell.until(lambda: cell.phase is Phase.HOLDING)


@on_cell("wrench", 1, guard=BRISK)
async def test_a_moving_arm_stands_before_the_jaws_open(cell: Cell) -> None:
    await cell.grasp()
    await cell.submit(LiftRequest())
    await cell.until(lambda: cell.truth.height_mm > 30.0)
    held_mm = cell.width_mm
    asked_s = cell.now_s
    await cell.submit(ReleaseRequest(confirm=True))
    await cell.until(lambda: cell.width_mm > held_mm + 0.1)
    height_mm = cell.truth.height_mm
    await cell.until(lambda: cell.phase is Phase.IDLE)
    assert cell.truth.height_mm == height_mm
    stopped_s = next(at_s for at_s, what, _ in cell.arm.commands if what == "stop" and at_s >= asked_s)
    opened_s = next(at_s for at_s, what, _ in cell.gripper.commands if what == "release")
    assert 0.0 < opened_s - stopped_s < 0.5


@on_cell("wrench", 1, guard=BRISK)
async def test_a_lost_stop_leaves_no_arm_moving_after_a_release(cell: Cell) -> None:
    await cell.grasp()
    await cell.submit(LiftRequest())
    await cell.until(lambda: cell.truth.height_mm > 30.0)
    stop, lost = cell.arm.stop, []

    async def loses() -> None:
        lost.append(cell.now_s)
        if len(lost) < 3:
            raise DeviceTimeout("arm: no answer within 50 ms")
        await stop()

    cell.arm.stop = loses  # type: ignore[method-assign]
    await cell.release()
    height_mm = cell.truth.height_mm
    await asyncio.sleep(0.5)
    assert cell.truth.height_mm == height_mm
    assert len(lost) >= 3


@on_cell("wrench", 1)
async def test_a_release_that_is_stuck_is_not_followed_by_a_tightening(cell: Cell) -> None:
    await cell.grasp()
    cell.world.faults.fail("gripper", "timeout")
    await cell.submit(ReleaseRequest(confirm=True))
    await asyncio.sleep(2.2)
    cell.world.faults.repair("gripper")
    await asyncio.sleep(0.3)
    assert cell.phase is Phase.FAULT
    cell.watched = False  # it may fall: the grip on it is lost
    cell.world.take_table(cell.now_s)
    holds = len(cell.gripper.commands)
    await asyncio.sleep(1.0)
    assert not [what for _, what, _ in cell.gripper.commands[holds:] if what == "hold"]


@on_cell("wrench", 1)
async def test_a_slip_after_it_is_met_with_force(cell: Cell) -> None:
    await cell.grasp()
    await cell.submit(LiftRequest())
    await cell.until(lambda: cell.truth.height_mm > 20.0)
    await stopped(cell)
    first_n = cell.truth.applied_n
    cell.world.add_mass(cell.now_s, 3.0)
    await asyncio.sleep(1.0)
    assert cell.truth.applied_n > first_n
    assert cell.truth.dropped is None
