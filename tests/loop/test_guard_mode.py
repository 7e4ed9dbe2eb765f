"""Guard mode: another program moves the arm and asks for the gripper; slipguard watches what is held."""

from __future__ import annotations

import asyncio

import pytest
from loop_cell import Cell, on_cell

from slipguard.control.state import Phase
from slipguard.daemon.api.requests import GuardRequest, LiftRequest, LowerRequest, MoveJawsRequest
from slipguard.errors import CommandRefused

GUARD: dict[str, object] = {"mode": "guard"}
GRIP_N = 40.0


async def gripped_by_another_program(cell: Cell) -> None:
    await cell.ready()
    await cell.submit(MoveJawsRequest(width_mm=0.0, force_n=GRIP_N))
    await cell.until(lambda: cell.phase is Phase.HOLDING)


async def lifted_by_another_program(cell: Cell, height_mm: float = 60.0) -> None:
    cell.world.command_lift(cell.now_s, 10.0, 20.0)
    await asyncio.sleep(0.8)
    await cell.until(cell.steady)
    cell.world.command_lift(cell.now_s, height_mm - cell.truth.height_mm, 40.0)
    await asyncio.sleep(2.5)


@on_cell("wrench", 1, guard=GUARD)
async def test_guarding_starts_by_itself_when_something_is_held(cell: Cell) -> None:
    await gripped_by_another_program(cell)
    await lifted_by_another_program(cell)
    assert cell.truth.dropped is None
    assert abs(cell.truth.rotation_deg) < 25.0
    assert cell.truth.applied_n > GRIP_N + 5.0
    assert any("tightening from" in line for line in cell.messages)
    assert all(what == "stop" for _, what, _ in cell.arm.commands)  # paused, never taken over


@on_cell("wrench", 1, guard=GUARD)
async def test_guard_on_guards_what_is_held_after_guard_off(cell: Cell) -> None:
    await cell.ready()
    await cell.submit(GuardRequest(on=False))
    await cell.submit(MoveJawsRequest(width_mm=0.0, force_n=GRIP_N))
    await cell.until(lambda: cell.truth.in_contact)
    await asyncio.sleep(1.0)
    assert cell.phase is Phase.IDLE
    await cell.submit(GuardRequest(on=True))
    await cell.until(lambda: cell.phase is Phase.HOLDING)
    await lifted_by_another_program(cell)
    assert cell.truth.dropped is None
    assert abs(cell.truth.rotation_deg) < 25.0


@on_cell("wrench", 1, guard=GUARD)
async def test_another_program_never_undercuts_the_guard(cell: Cell) -> None:
    await gripped_by_another_program(cell)
    await lifted_by_another_program(cell)
    guarded_n = cell.truth.applied_n
    assert guarded_n > GRIP_N + 5.0
    response = await cell.submit(MoveJawsRequest(force_n=25.0))
    assert f"{guarded_n:.0f} N" in response
    with pytest.raises(CommandRefused, match="opening would drop it; support it, then use release"):
        await cell.submit(MoveJawsRequest(width_mm=80.0, force_n=25.0))
    with pytest.raises(CommandRefused, match="force limit of 130 N"):
        await cell.submit(MoveJawsRequest(force_n=200.0))
    await asyncio.sleep(0.3)
    assert cell.truth.applied_n == pytest.approx(guarded_n)
    await cell.submit(MoveJawsRequest(force_n=125.0))
    await asyncio.sleep(0.3)
    assert cell.truth.applied_n >= 125.0


@on_cell("wrench", 1, guard=GUARD)
async def test_slipguard_does_not_move_an_arm_that_is_not_its_own(cell: Cell) -> None:
    await gripped_by_another_program(cell)
    for request in (LiftRequest(), LowerRequest()):
        with pytest.raises(CommandRefused, match="the arm belongs to another program"):
            await cell.submit(request)
    await cell.release()
    assert not cell.truth.in_contact
