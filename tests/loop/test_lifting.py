"""Lift mode from grasp to release, with the real world, controller and fakes."""

from __future__ import annotations

import asyncio

import pytest
from loop_cell import Cell, on_cell, play
from sampled import sampled

from slipguard.control.control_step import control_step
from slipguard.control.state import Phase
from slipguard.daemon.api.requests import GraspRequest, LiftRequest
from slipguard.daemon.loop.service import Controller
from slipguard.errors import CommandRefused

BRISK = {"lift_height_mm": 60.0, "lift_speed_mm_s": 100.0, "tuning": {"lower_speed_mm_s": 150.0}}


def carried(
    object_name: str, seed: int, controller: Controller = control_step, height_mm: float = 60.0
) -> tuple[Cell, list[float]]:
    """Grasp, lift, hold for a second, lower, release; return all rotations on the way."""
    rotations: list[float] = []

    async def scene(cell: Cell) -> None:
        cell.service.observers.append(lambda decision: rotations.append(abs(cell.truth.rotation_deg)))
        await cell.grasp()
        await cell.lift()
        await asyncio.sleep(1.0)
        if controller is control_step:
            assert cell.phase is Phase.HOLDING, cell.service.state.fault
            assert cell.truth.dropped is None
            assert cell.truth.height_mm == pytest.approx(height_mm, abs=1.0)
            await cell.lower()
            assert cell.truth.height_mm == pytest.approx(0.0, abs=1.0)
        await cell.release()
        assert cell.width_mm == pytest.approx(85.0, abs=0.5)
        assert not cell.truth.in_contact

    return play(
        Cell(object_name, seed, guard=BRISK | {"lift_height_mm": height_mm}, controller=controller), scene
    ), rotations


@pytest.mark.parametrize("seed", sampled([1, 2], every=2))
@pytest.mark.parametrize("object_name", ["bar", "wrench", "knife_edge", "key"])
def test_an_object_is_carried_and_put_down(object_name: str, seed: int) -> None:
    cell, rotations = carried(object_name, seed)
    assert max(rotations) < 20.0
    assert cell.phases == [
        Phase.IDLE, Phase.CLOSING, Phase.REFERENCE, Phase.HOLDING, Phase.LIFTING,
        Phase.HOLDING, Phase.LOWERING, Phase.HOLDING, Phase.RELEASED, Phase.IDLE,
    ]  # fmt: skip
    assert [what for _, what, _ in cell.gripper.commands].count("release") == 1
    assert cell.service.deadlines_missed == 0


DECLINED = {"left": "round contact", "right": "round contact"}


@on_cell("ball", 1, guard=BRISK, declined=DECLINED)
async def test_an_object_without_estimate_is_gripped_firmly_before_the_lift(cell: Cell) -> None:
    await cell.grasp()
    assert cell.service.state.held.no_estimate is not None
    assert cell.truth.applied_n >= 100.0
    assert cell.truth.force_n >= 85.0  # a gripper may be 10 % weaker than it says
    assert cell.truth.height_mm == 0.0
    await cell.lift()
    await asyncio.sleep(0.5)
    assert cell.phase is Phase.HOLDING
    assert cell.truth.dropped is None


@on_cell("ball", 1, guard=BRISK, declined=DECLINED)
async def test_it_is_not_lifted_before_the_firm_grip_is_there(cell: Cell) -> None:
    """Asked in the very tick in which the force is commanded, when the gripper's last word is still that it rests."""
    await cell.ready()
    await cell.submit(GraspRequest())
    await cell.until(lambda: cell.phase is Phase.REFERENCE)
    holding = asyncio.Event()
    cell.service.observers.append(lambda decision: decision.phase is Phase.HOLDING and holding.set())
    await holding.wait()
    with pytest.raises(CommandRefused, match="the grip is not firm yet"):
        await cell.submit(LiftRequest())
    await cell.until(cell.steady)
    await cell.submit(LiftRequest())
    assert cell.truth.force_n >= 85.0


@on_cell("ball", 1, guard=BRISK | {"on_no_estimate": "refuse"}, declined=DECLINED)
async def test_an_object_without_estimate_is_not_lifted_where_that_is_refused(cell: Cell) -> None:
    await cell.grasp()
    with pytest.raises(CommandRefused, match=r"no rotation estimate \(left finger: round contact"):
        await cell.submit(LiftRequest())
    assert cell.truth.applied_n < 45.0
    assert not [command for command in cell.arm.commands if command[1] == "lift"]
    await cell.release()


@on_cell("wrench", 1, latency_s=0.03)
async def test_an_estimate_computed_during_a_reset_of_the_reference_is_dropped(cell: Cell) -> None:
    await cell.grasp()
    finger, oracle = cell.service.fingers["left"], cell.perceivers["left"][0]
    await cell.until(lambda: finger.newest is not None and finger.newest.estimate.sequence < oracle.sequence)
    under_way = oracle.sequence
    finger.reset_reference()
    assert finger.newest is None
    await finger.has_estimate.wait()
    assert finger.newest is not None
    assert finger.newest.estimate.sequence > under_way
    assert finger.newest.estimate.rotation_deg is None
