"""A stop of the arm while the jaws close or tighten, and a release while the arm moves, on the real world and fakes."""

from __future__ import annotations

import asyncio

import pytest
from loop_cell import Cell, play

from slipguard.control.state import Phase
from slipguard.daemon.api.requests import ClearRequest, GraspRequest, LiftRequest, MoveJawsRequest, ReleaseRequest
from slipguard.errors import DeviceTimeout

BRISK = {"lift_speed_mm_s": 100.0, "tuning": {"lower_speed_mm_s": 60.0}}
STOPS = ["protective_stop", "emergency_stop"]


@pytest.mark.parametrize("stop", STOPS)
@pytest.mark.parametrize("lost", [0, 1])
def test_jaws_on_their_way_stand_and_close_only_when_asked_again(stop: str, lost: int) -> None:
    async def scene(cell: Cell) -> None:
        assert cell.world is not None
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

    play(Cell("wrench", 1), scene)


@pytest.mark.parametrize("stop", STOPS)
def test_a_force_that_rises_stays_where_it_is_until_clear(stop: str) -> None:
    async def scene(cell: Cell) -> None:
        assert cell.world is not None
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

    play(Cell("wrench", 1), scene)


def test_a_moving_arm_stands_before_the_jaws_open() -> None:
    async def scene(cell: Cell) -> None:
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

    play(Cell("wrench", 1, guard=BRISK), scene)


def test_a_lost_stop_leaves_no_arm_moving_after_a_release() -> None:
    async def scene(cell: Cell) -> None:
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

    play(Cell("wrench", 1, guard=BRISK), scene)


def test_a_release_that_is_stuck_is_not_followed_by_a_tightening() -> None:
    async def scene(cell: Cell) -> None:
        assert cell.world is not None
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

    play(Cell("wrench", 1), scene)
