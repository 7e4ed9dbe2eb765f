"""The daemon killed as by `kill -9` with something held, and started again on the same cell."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable

import pytest

from slipguard.control.reports import FaultCode
from slipguard.control.state import Phase
from slipguard.daemon.api.requests import ClearRequest, GraspRequest, LiftRequest, LowerRequest, MoveJawsRequest
from slipguard.daemon.api.snapshot import snapshot
from slipguard.daemon.loop.virtual_time import run_virtual
from slipguard.errors import CommandRefused
from tests.campaigns.faults.campaign_cell import CampaignCell

DEAD_S = 0.5
ASKED_N = 130.0


async def until(reached: Callable[[], bool], within_s: float = 10.0) -> None:
    deadline_s = asyncio.get_running_loop().time() + within_s
    while not reached():
        assert asyncio.get_running_loop().time() < deadline_s
        await asyncio.sleep(0.01)


def play(scene: Callable[[CampaignCell], Awaitable[None]], guard: dict[str, object] | None = None) -> list[str]:
    """A scene that begins with an object gripped; returns the log."""
    lines: list[str] = []

    async def main() -> None:
        rig = CampaignCell("wrench", 3, guard or {}, lines.append)
        rig.place()
        rig.start()
        await until(lambda: not rig.service.waiting_for)
        await (
            rig.handlers.submit(GraspRequest())
            if not guard
            else rig.handlers.submit(MoveJawsRequest(width_mm=0.0, force_n=40.0))
        )
        await until(lambda: rig.service.ready_to_lift)
        await asyncio.sleep(0.5)
        await scene(rig)
        assert rig.truth.dropped is None
        assert (rig.releases, rig.crashes) == (0, [])
        await rig.stop()

    run_virtual(main())
    return lines


@pytest.mark.parametrize("arrived", [False, True])
def test_a_force_on_its_way_when_the_daemon_was_killed_is_applied_after_all(arrived: bool) -> None:
    async def scene(rig: CampaignCell) -> None:
        if not arrived:
            rig.world.faults.fail("gripper", "timeout")
        await rig.handlers.submit(MoveJawsRequest(force_n=ASKED_N))
        await asyncio.sleep(0.1)
        await rig.kill()
        await asyncio.sleep(DEAD_S)
        assert (rig.truth.force_n > 100.0) is arrived
        rig.world.faults.repair("gripper")
        rig.start()
        await until(lambda: rig.service.ready_to_lift)
        await asyncio.sleep(0.5)
        assert rig.truth.force_n > 120.0
        rig.world.take_table(rig.now_s)
        await asyncio.sleep(4.0)
        assert abs(rig.truth.rotation_deg) < 15.0

    lines = play(scene)
    assert any("are commanded again" in line for line in lines), "whether it arrived is not known after a restart"


def test_after_a_restart_in_the_air_the_unknown_is_unknown_and_the_object_is_lowered() -> None:
    async def scene(rig: CampaignCell) -> None:
        await rig.handlers.submit(LiftRequest())
        await until(lambda: rig.truth.height_mm > 15.0)
        held_n, height_mm = rig.service.state.grip.target_n, rig.truth.height_mm
        await rig.kill()
        await asyncio.sleep(DEAD_S)
        rig.start()
        await until(lambda: rig.service.gripper.newest is not None and rig.service.gripper.newest.holding)
        gripper = rig.service.gripper.newest
        assert gripper is not None
        assert (gripper.force_known, gripper.force_n) == (False, 20.0)
        await until(lambda: rig.service.ready_to_lift)
        assert rig.service.state.grip.target_n == held_n
        shown = snapshot(rig.service, {})
        assert shown.lifted_mm == pytest.approx(rig.truth.height_mm, abs=0.1)
        assert rig.truth.height_mm >= height_mm
        await asyncio.sleep(0.5)
        await rig.handlers.submit(LowerRequest())
        await until(lambda: rig.service.phase is Phase.HOLDING)
        assert rig.truth.height_mm == pytest.approx(0.0, abs=0.6)

    lines = play(scene)
    assert any("taken over with the" in line for line in lines)


def test_a_latched_fault_outlives_the_daemon() -> None:
    async def scene(rig: CampaignCell) -> None:
        rig.world.faults.fail("gripper", "fault")
        await until(lambda: rig.service.phase is Phase.FAULT)
        fault = rig.service.state.fault
        await asyncio.sleep(0.2)
        await rig.kill()
        rig.world.faults.repair("gripper")
        await asyncio.sleep(DEAD_S)
        rig.start()
        await until(lambda: rig.service.state.grip.closed)
        assert (rig.service.phase, rig.service.state.fault) == (Phase.FAULT, fault)
        assert fault is not None
        assert fault.code is FaultCode.GRIPPER_FAULT
        await asyncio.sleep(1.0)
        with pytest.raises(CommandRefused, match=r"a fault is latched \(gripper fault\); clear it first"):
            await rig.handlers.submit(LiftRequest())
        await rig.handlers.submit(ClearRequest())
        await until(lambda: rig.service.ready_to_lift)
        await rig.handlers.submit(LiftRequest())

    lines = play(scene)
    assert sum("fault: gripper fault" in line for line in lines) == 2, "named by both daemons"
    assert not any("frames lost" in line for line in lines), "sensors are given the time to start"


@pytest.mark.parametrize(
    ("gone", "code"),
    [(("left", "right"), FaultCode.FRAMES_LOST), (("gripper",), FaultCode.GRIPPER_SILENT)],
)
def test_a_device_that_stays_away_after_a_restart_stops_the_arm(gone: tuple[str, ...], code: FaultCode) -> None:
    async def scene(rig: CampaignCell) -> None:
        await rig.kill()
        await asyncio.sleep(DEAD_S)
        for device in gone:
            rig.world.faults.fail(device, "disconnect")
        rig.start()
        rig.world.command_lift(rig.now_s, 200.0, 20.0)  # the other program knows of nothing
        await asyncio.sleep(1.0)
        assert rig.service.phase is Phase.IDLE
        await until(lambda: rig.service.phase is Phase.FAULT, 1.5)
        assert rig.service.state.fault is not None
        assert rig.service.state.fault.code is code
        await asyncio.sleep(0.3)
        assert not rig.world.arm_state(rig.now_s).moving
        for device in gone:
            rig.world.faults.repair(device)
        await until(lambda: not rig.service.waiting_for)
        await asyncio.sleep(0.5)
        assert rig.service.phase is Phase.FAULT
        await rig.handlers.submit(ClearRequest())
        await until(lambda: rig.service.ready_to_lift)

    play(scene, {"mode": "guard"})
