"""Devices that are missing at the start, a shutdown at any moment, and a restart with an object in the fingers."""

from __future__ import annotations

import asyncio

import numpy as np
import pytest
from loop_cell import Cell, play, running
from sampled import sampled

from slipguard.control.state import Phase
from slipguard.daemon.api.requests import GraspRequest, ReleaseRequest
from slipguard.daemon.loop.virtual_time import run_virtual
from slipguard.errors import CommandRefused
from slipguard.sim.world import World

BRISK: dict[str, object] = {"lift_height_mm": 50.0, "lift_speed_mm_s": 80.0, "tuning": {"lower_speed_mm_s": 150.0}}
DEVICES = ("left", "right", "gripper", "arm")


@pytest.mark.parametrize("device", DEVICES)
def test_a_device_missing_at_the_start_is_waited_for_by_name(device: str) -> None:
    async def scene(cell: Cell) -> None:
        assert cell.world is not None
        cell.world.faults.fail(device, "disconnect")
        await asyncio.sleep(7.0)
        (line,) = cell.service.waiting_for
        assert line.startswith(f"{device}: no ")
        with pytest.raises(CommandRefused, match=f"cannot grasp: not ready: {device}: (?!{device}: )"):
            await cell.submit(GraspRequest())
        cell.world.faults.repair(device)
        await cell.until(lambda: not cell.service.waiting_for, 5.1)  # ten times the first pause is the longest
        await cell.grasp()
        assert cell.phase is Phase.HOLDING

    play(Cell("wrench", 1), scene)


def test_without_any_device_the_service_waits_and_names_them() -> None:
    async def scene(cell: Cell) -> None:
        assert cell.world is not None
        for device in DEVICES:
            cell.world.faults.fail(device, "disconnect")
        await asyncio.sleep(3.0)
        assert [line.split(":")[0] for line in cell.service.waiting_for] == list(DEVICES)
        assert cell.phase is Phase.IDLE
        response = await cell.submit(ReleaseRequest(confirm=True))
        assert response == "releasing, as requested: when the arm stands, after 0.5 s at the latest"

    play(Cell(), scene)


@pytest.mark.parametrize("seed", sampled(range(20), every=6))
def test_a_shutdown_at_any_moment_leaves_the_grip_as_it_is(seed: int) -> None:
    """`running` checks that no task is left and that the workers are closed."""
    moment_s = float(np.random.default_rng(seed).uniform(0.0, 7.0))

    async def main() -> None:
        cell = Cell("wrench", seed, guard=BRISK)
        async with running(cell):
            errand = asyncio.create_task(carry(cell))
            await asyncio.sleep(moment_s)
            before, count = cell.truth, len(cell.gripper.commands)
            errand.cancel()
            await asyncio.gather(errand, return_exceptions=True)
        await asyncio.sleep(2.0)
        after = cell.truth
        assert len(cell.gripper.commands) == count
        assert not any(what in ("release", "move") for _, what, _ in cell.gripper.commands)
        assert after.force_n >= before.force_n
        assert after.in_contact or not before.in_contact
        stopped_mm = cell.truth.height_mm
        await asyncio.sleep(0.5)
        assert cell.truth.height_mm == stopped_mm

    run_virtual(main())


async def carry(cell: Cell) -> None:
    await cell.grasp()
    await cell.lift()
    await cell.lower()


def test_requests_to_a_stopping_service_are_refused() -> None:
    async def main() -> None:
        cell = Cell()
        async with running(cell):
            await cell.ready()
            asked = [asyncio.create_task(cell.submit(GraspRequest())) for _ in range(3)]
            await asyncio.sleep(0)
        ends = await asyncio.gather(*asked, return_exceptions=True)
        assert str(ends[0]).startswith("closing")
        assert [str(end) for end in ends[1:]] == 2 * ["grasp: slipguard is stopping"]

    run_virtual(main())


@pytest.mark.parametrize("first", ["left", "gripper", "arm"])
def test_a_restart_adopts_the_held_object_and_guards_it(first: str) -> None:
    """The new service finds the devices in another order each time; this neither loosens the grip nor needs help."""

    async def main() -> None:
        world = World(seed=1)
        old = Cell("wrench", 1, guard=BRISK, world=world)
        old.fresh = True
        async with running(old):
            await old.grasp()
            held_n = old.truth.applied_n
        new = Cell("wrench", 1, guard=BRISK, world=world)
        for device in DEVICES:
            if device != first:
                world.faults.fail(device, "disconnect")
        async with running(new):
            await asyncio.sleep(1.0)
            for device in DEVICES:
                world.faults.repair(device)
                await asyncio.sleep(0.3)
            await new.until(new.steady)
            assert new.service.state.held.referenced
            assert new.truth.applied_n == held_n
            assert new.gripper.commands == []
            assert Phase.FAULT not in new.phases, new.messages
            await new.lift()
            await asyncio.sleep(0.5)
            assert new.phase is Phase.HOLDING
            assert new.truth.dropped is None
            assert abs(new.truth.rotation_deg) < 20.0
            assert new.truth.applied_n > held_n

    run_virtual(main())


def test_a_missing_arm_does_not_leave_a_found_object_unguarded() -> None:
    async def main() -> None:
        world = World(seed=1)
        old = Cell("wrench", 1, guard=BRISK, world=world)
        old.fresh = True
        async with running(old):
            await old.grasp()
        new = Cell("wrench", 1, guard=BRISK, world=world)
        world.faults.fail("arm", "disconnect")
        async with running(new):
            await new.until(lambda: new.phase is Phase.FAULT)
            assert any("arm silent" in line for line in new.service.event_log.lines)
            assert new.service.state.guarding
            assert new.truth.in_contact
            events = new.service.event_log.events
            world.faults.fail("gripper", "disconnect")
            await new.until(lambda: any("gripper silent" in event.text for event in events))
            assert {event.level for event in events if "gripper silent" in event.text} == {"warning"}, (
                "in addition to a fault"
            )

    run_virtual(main())


def test_a_restart_with_nothing_held_is_idle() -> None:
    async def scene(cell: Cell) -> None:
        await cell.ready()
        await asyncio.sleep(1.0)
        assert cell.phases == [Phase.IDLE]
        assert cell.gripper.commands == []
        assert cell.arm.commands == []

    play(Cell(), scene)
