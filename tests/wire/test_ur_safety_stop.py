"""Lift mode after a safety stop: the paused script is ended, and the arm comes back under control without a jump."""

from __future__ import annotations

import asyncio
import math
from collections.abc import AsyncIterator

import pytest
from ur_scene import (
    BUILT,
    lifting,
    lost,
    opened,
    own_address,
    put_away,
    rests,
    script_commands,
    speed_of,
    under_way,
    until,
)

from slipguard.cancellation import cancel_and_wait
from slipguard.devices import Arm, ArmState
from slipguard.errors import CommandRefused, DeviceError, DeviceLost, DeviceTimeout
from slipguard_drivers.ur5.lift_mode import AFTER_STOP_MM_S, LiftModeArm
from slipguard_emulators.ur5.emulator import UrEmulator

HOST = own_address(36)
PAUSING_STOPS = ["protective_stop", "safeguard_stop", "enabling_stop"]


@pytest.fixture(autouse=True)
async def _put_away() -> AsyncIterator[None]:
    yield
    await put_away()


@pytest.fixture
async def controller() -> AsyncIterator[UrEmulator]:
    controller = UrEmulator(UrEmulator.Settings(host=HOST, series="cb3", ready=True))
    await controller.start()
    yield controller
    await controller.stop()


@pytest.fixture
async def arm(controller: UrEmulator) -> AsyncIterator[LiftModeArm]:
    arm = lifting(HOST)
    await arm.open()
    yield arm
    await put_away()


async def state_of(arm: Arm) -> ArmState | None:
    """The state, None while it is late."""
    try:
        return await arm.state()
    except DeviceTimeout:
        return None


async def reported_stop(arm: Arm) -> ArmState:
    """Wait until the state reports a stop and rest."""
    async with asyncio.timeout(4.0):
        while True:
            state = await state_of(arm)
            if state is not None and (state.protective_stop or state.emergency_stop) and not state.moving:
                return state
            await asyncio.sleep(0.005)


async def regained(arm: Arm, within_s: float = 15.0) -> ArmState:
    """Wait until the state reports no stop; the arm is never lost meanwhile."""
    async with asyncio.timeout(within_s):
        while True:
            state = await state_of(arm)
            if state is not None and not (state.protective_stop or state.emergency_stop):
                return state
            await asyncio.sleep(0.005)


async def lifted(arm: Arm, height_mm: float, speed_mm_s: float) -> float:
    """Lift; a machine too busy for the deadlines is given further chances."""
    for _ in range(3):
        try:
            return await arm.lift(height_mm, speed_mm_s)
        except DeviceError:
            await arm.open()
    return await arm.lift(height_mm, speed_mm_s)


@pytest.mark.parametrize("refuses", [False, True], ids=["ends at once", "refuses to end it during the stop"])
@pytest.mark.parametrize("stop", PAUSING_STOPS)
async def test_the_arm_comes_back_under_control(
    controller: UrEmulator, arm: LiftModeArm, stop: str, refuses: bool
) -> None:
    await under_way(arm, controller)
    if refuses:
        controller.control("fault refuse_stop")
    controller.control(f"fault {stop}")
    assert await rests(controller)
    stopped = await reported_stop(arm)
    assert (stopped.protective_stop, stopped.emergency_stop) == (True, False)
    assert stopped.height_mm > 0.0
    assert await until(lambda: controller.state()["runtime"] == ("paused" if refuses else "stopped"))
    with pytest.raises(CommandRefused, match="stop is active"):
        await arm.lift(10.0, 50.0)
    controller.control(f"clear {stop}")
    await asyncio.sleep(0.1)
    after = await regained(arm)
    assert after.height_mm == pytest.approx(stopped.height_mm, abs=25.0), "heights count from where they did before"
    assert not [event for event in controller.events("dashboard") if "unlock" in str(event["asked"])]
    started = [event for event in controller.events("started") if "shuttle" in str(event["program"])]
    assert not started, "a program that was ended during a stop does not continue"
    assert await lifted(arm, -20.0, 200.0) == AFTER_STOP_MM_S
    assert await until(lambda: speed_of(controller) > 0.01)
    assert speed_of(controller) < 0.03
    await arm.stop()
    assert await rests(controller)
    assert await lifted(arm, -2.0, 200.0) == AFTER_STOP_MM_S, "it was stopped on the way"
    assert await until(lambda: speed_of(controller) > 0.01)
    assert await rests(controller)
    assert await lifted(arm, -10.0, 200.0) == 200.0, "slow only until a motion has reached its goal"


async def test_an_emergency_stop_keeps_the_heights(controller: UrEmulator, arm: LiftModeArm) -> None:
    await under_way(arm, controller)
    controller.control("fault emergency_stop")
    assert await rests(controller)
    stopped = await reported_stop(arm)
    assert (stopped.protective_stop, stopped.emergency_stop) == (False, True)
    controller.control("panel remote")
    controller.control("clear")
    assert (await regained(arm)).height_mm == pytest.approx(stopped.height_mm, abs=1.0)


async def test_a_program_resumed_at_the_panel_is_ended(controller: UrEmulator, arm: LiftModeArm) -> None:
    await under_way(arm, controller)
    controller.control("fault refuse_stop")
    controller.control("fault protective_stop")
    assert await rests(controller)
    assert await until(lambda: controller.state()["runtime"] == "paused")
    height_m = controller.state()["pose"][2]  # type: ignore[index]
    controller.control("clear protective_stop")
    controller.control("panel play")
    assert controller.state()["runtime"] == "playing"
    assert await until(lambda: controller.state()["runtime"] == "stopped")
    await regained(arm)
    assert controller.state()["pose"][2] < height_m + 0.05  # type: ignore[index]
    assert script_commands(controller).count("movel in a thread") == 1


async def test_what_prevents_control_after_a_stop_is_reported(controller: UrEmulator, arm: LiftModeArm) -> None:
    await under_way(arm, controller)
    controller.control("fault protective_stop")
    assert await until(lambda: arm._script.has_ended)
    controller.control("clear")
    controller.control("panel play")
    assert await until(lambda: arm._blocked)
    with pytest.raises(DeviceTimeout, match=r"a program is running or paused \(PLAYING shuttle.urp\)"):
        await arm.state()
    with pytest.raises(CommandRefused, match="not under control again"):
        await arm.lift(10.0, 50.0)
    assert controller.state()["runtime"] == "playing", "another program is not ended"
    controller.control("panel stop")
    await regained(arm)


async def test_a_script_that_ends_later_is_no_second_stop(controller: UrEmulator, arm: LiftModeArm) -> None:
    await under_way(arm, controller)
    controller.control("fault protective_stop")
    await reported_stop(arm)
    controller.control("clear")
    await asyncio.sleep(0.1)
    await regained(arm)
    await asyncio.sleep(0.2)
    controller.control("panel stop")
    stops, why = 0, ""
    async with asyncio.timeout(4.0):
        while not why:
            try:
                state = await state_of(arm)
                stops += state is not None and state.protective_stop
            except DeviceLost as error:
                why = str(error)
            await asyncio.sleep(0.002)
    assert why
    assert stops == 0


async def test_a_stop_after_close_leaves_no_paused_script(controller: UrEmulator, arm: LiftModeArm) -> None:
    await under_way(arm, controller)
    controller.control("fault refuse_stop")
    controller.control("fault protective_stop")
    assert await until(lambda: controller.state()["runtime"] == "paused")
    await asyncio.sleep(0.2)
    controller.control("clear refuse_stop")
    await arm.close()
    assert controller.state()["runtime"] == "stopped"


async def test_a_link_lost_during_a_stop(controller: UrEmulator, arm: LiftModeArm) -> None:
    await under_way(arm, controller)
    controller.control("fault refuse_stop")
    controller.control("fault protective_stop")
    assert await until(lambda: controller.state()["runtime"] == "paused")
    controller.control("fault drop 1")
    await lost(arm)
    await arm.open()
    assert (await arm.state()).protective_stop
    controller.control("clear")
    assert await regained(arm)
    assert controller.state()["program"] == "<unnamed>"


async def paused_by_a_stop(arm: Arm, controller: UrEmulator) -> None:
    """Lift, and stop; the dashboard ends nothing meanwhile."""
    await under_way(arm, controller)
    controller.control("fault refuse_stop")
    controller.control("fault protective_stop")
    assert await until(lambda: controller.state()["runtime"] == "paused")


async def killed(arm: LiftModeArm) -> None:
    """Leave the robot as a daemon that was killed leaves it."""
    BUILT.remove(arm)
    await cancel_and_wait(arm._heartbeat)
    arm._worker.close()
    await arm._monitor.close()
    arm._dashboard.close()


async def test_a_link_lost_for_long_during_a_stop(controller: UrEmulator, arm: LiftModeArm) -> None:
    """The script's watchdog stands still during the pause: the script is still there whenever the link is back."""
    await paused_by_a_stop(arm, controller)
    controller.control("fault drop 1")
    await lost(arm)
    arm._script._until_s = -math.inf  # the time after which the watchdog has ended a running script
    controller.control("clear drop")
    await opened(arm)
    controller.control("clear")
    assert (await regained(arm)).height_mm < 50.0
    assert [event["why"] for event in controller.events("ended")] == ["stopped by the dashboard"]


@pytest.mark.parametrize("registers", ["lower", "upper"])
async def test_a_script_paused_before_a_restart_is_ended_and_the_arm_comes_back(
    controller: UrEmulator, registers: str
) -> None:
    arm = lifting(HOST, registers=registers)
    await opened(arm)
    await paused_by_a_stop(arm, controller)
    await killed(arm)
    after = lifting(HOST, registers=registers)
    await opened(after)
    assert (await reported_stop(after)).height_mm == pytest.approx(0.0, abs=0.5)
    controller.control("clear refuse_stop")
    assert await until(lambda: controller.state()["runtime"] == "stopped"), "during the stop already"
    controller.control("clear")
    await regained(after)
    assert controller.state()["program"] == "<unnamed>"
    assert await lifted(after, -5.0, 200.0) == AFTER_STOP_MM_S


async def test_another_program_paused_by_a_stop_is_not_ended_after_a_restart(controller: UrEmulator) -> None:
    arm = lifting(HOST)
    await opened(arm)
    await arm.close()  # clears the script's mark
    controller.control("panel play")
    controller.control("fault protective_stop")
    after = lifting(HOST)
    await opened(after)
    await reported_stop(after)
    await asyncio.sleep(0.6)
    controller.control("clear")
    assert await until(lambda: after._blocked)
    assert controller.state()["runtime"] == "paused"
    assert controller.state()["program"] == "shuttle.urp"


async def test_a_mark_alone_ends_no_paused_program(controller: UrEmulator, arm: LiftModeArm) -> None:
    await under_way(arm, controller)
    await killed(arm)
    assert await until(lambda: controller.state()["runtime"] == "stopped"), "by the watchdog, so the mark stays"
    controller.control("panel play")
    controller.control("panel pause")
    with pytest.raises(DeviceLost, match="it may be the script that slipguard left"):
        await lifting(HOST).open()
    assert controller.state()["runtime"] == "paused"


async def test_without_a_process_for_the_worker_the_arm_is_lost_and_can_be_reopened(
    controller: UrEmulator, arm: LiftModeArm, monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_process() -> None:
        raise OSError("Cannot allocate memory")

    await under_way(arm, controller)
    controller.control("fault protective_stop")
    await reported_stop(arm)
    with monkeypatch.context() as patch:
        patch.setattr(arm._worker, "start_spare", no_process)
        controller.control("clear")
        assert "OSError: Cannot allocate memory" in await lost(arm)
    await opened(arm)
    await arm.state()


async def test_an_arm_reopened_after_a_stop_still_moves_slowly(controller: UrEmulator, arm: LiftModeArm) -> None:
    await under_way(arm, controller)
    controller.control("fault protective_stop")
    await reported_stop(arm)
    controller.control("clear")
    await regained(arm)
    await arm.close()
    await opened(arm)
    assert await lifted(arm, 5.0, 200.0) == AFTER_STOP_MM_S
