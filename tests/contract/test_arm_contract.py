"""The contract of `slipguard.devices.Arm`, checked on every arm."""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections.abc import AsyncIterator

import pytest
from arm_rigs import ArmRig, abilities, make_rig
from rig import needs, parametrize_rig
from timeouts import eventually, first_value

from slipguard.devices import Arm, ArmState
from slipguard.errors import CommandRefused, DeviceError, DeviceLost, DeviceTimeout

BOTH_SERIES = {
    "test_a_lift_starts_and_does_not_wait",
    "test_a_new_lift_replaces_the_motion",
    "test_stop_ends_a_motion_and_may_be_called_at_any_time",
    "test_a_safety_stop_is_reported_and_refuses_motion",
    "test_in_guard_mode_it_is_monitored_and_paused_and_never_moved",
}
"""Checked with the faster controllers too; the others do not depend on the rate."""
guard_mode = pytest.mark.parametrize("mode", ["guard"])


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    both_series = metafunc.function.__name__ in BOTH_SERIES
    parametrize_rig(metafunc, abilities(metafunc.config, both_series=both_series))


@pytest.fixture
def mode() -> str:
    return "lift"


@pytest.fixture
async def rig(request: pytest.FixtureRequest, mode: str) -> AsyncIterator[ArmRig]:
    rig = make_rig(request.param, "guard" if mode == "guard" else "lift", request.config)
    await rig.start()
    yield rig
    await rig.arm.close()
    await rig.arm.close()
    await rig.stop()


@pytest.fixture
async def arm(rig: ArmRig) -> Arm:
    await rig.arm.open()
    return rig.arm


def at_rest(state: ArmState) -> bool:
    return not state.moving and state.speed_mm_s == pytest.approx(0.0, abs=0.5)


async def test_heights_are_relative_to_where_the_arm_was_opened(rig: ArmRig, arm: Arm) -> None:
    assert (await first_value(arm.state)).height_mm == pytest.approx(0.0, abs=0.1)
    await arm.lift(10.0, 200.0)
    await eventually(arm.state, lambda state: state.height_mm > 9.9 and at_rest(state))
    await arm.close()
    await arm.open()
    assert (await first_value(arm.state)).height_mm == pytest.approx(0.0, abs=0.1)


async def test_a_reported_orientation_is_a_rotation_vector_and_stays_during_a_lift(arm: Arm) -> None:
    before = (await first_value(arm.state)).orientation_rad
    await arm.lift(10.0, 200.0)
    after = (await eventually(arm.state, lambda state: state.height_mm > 9.9 and at_rest(state))).orientation_rad
    assert (before is None) is (after is None)
    if before is not None and after is not None:  # by half a turn, both directions of the axis are the same
        assert math.hypot(*after) == pytest.approx(math.hypot(*before), abs=0.01)


async def test_a_reported_up_is_a_unit_vector_along_z_of_an_upright_arm(arm: Arm) -> None:
    up = (await first_value(arm.state)).up
    if up is not None:
        assert math.hypot(*up) == pytest.approx(1.0, abs=1e-3)
        assert up[2] > math.cos(math.radians(10.0))


@pytest.mark.realtime
async def test_a_lift_starts_and_does_not_wait(arm: Arm) -> None:
    before_s = asyncio.get_running_loop().time()
    assert await arm.lift(30.0, 100.0) == pytest.approx(100.0)
    assert asyncio.get_running_loop().time() - before_s < 0.2, "30 mm at 100 mm/s take 0.38 s"
    await eventually(arm.state, lambda state: state.moving and state.speed_mm_s > 0)
    await eventually(arm.state, lambda state: at_rest(state) and state.height_mm == pytest.approx(30.0, abs=0.2))
    await arm.lift(-20.0, 100.0)
    await eventually(arm.state, lambda state: at_rest(state) and state.height_mm == pytest.approx(10.0, abs=0.2))


async def test_a_speed_above_the_limit_is_reduced_and_returned(arm: Arm) -> None:
    assert 0 < await arm.lift(5.0, 1e6) <= 1000.0


async def test_a_new_lift_replaces_the_motion(rig: ArmRig, arm: Arm) -> None:
    await arm.lift(rig.far_mm, 150.0)
    await eventually(arm.state, lambda state: state.speed_mm_s > 100.0)
    assert await arm.lift(20.0, 20.0) == pytest.approx(20.0)
    await eventually(arm.state, lambda state: 15.0 < state.speed_mm_s < 25.0)
    await arm.lift(-10.0, 100.0)
    await eventually(arm.state, lambda state: state.speed_mm_s < -10.0)
    stopped = await eventually(arm.state, at_rest)
    assert stopped.height_mm < rig.far_mm / 2


async def test_stop_ends_a_motion_and_may_be_called_at_any_time(rig: ArmRig, arm: Arm) -> None:
    await arm.stop()
    await arm.lift(rig.far_mm, 150.0)
    await arm.stop()
    assert (await eventually(arm.state, at_rest)).height_mm < rig.far_mm / 4, "stopped at once"
    await arm.lift(rig.far_mm, 150.0)
    await eventually(arm.state, lambda state: state.height_mm > 5.0)
    await arm.stop()
    await arm.stop()
    stopped = await eventually(arm.state, at_rest)
    assert stopped.height_mm < rig.far_mm / 2
    await asyncio.sleep(0.1)
    assert (await first_value(arm.state)).height_mm == pytest.approx(stopped.height_mm, abs=0.1)


async def test_stop_may_be_called_while_a_lift_is_being_commanded(rig: ArmRig, arm: Arm) -> None:
    await arm.lift(rig.far_mm, 150.0)
    lifted, stopped = await asyncio.gather(arm.lift(rig.far_mm, 150.0), arm.stop(), return_exceptions=True)
    assert stopped is None
    assert isinstance(lifted, float | CommandRefused)
    await arm.stop()
    assert (await eventually(arm.state, at_rest)).height_mm < rig.far_mm / 4


async def test_close_stops_the_arm(rig: ArmRig, arm: Arm) -> None:
    await arm.lift(rig.far_mm, 150.0)
    await eventually(arm.state, lambda state: state.moving)
    await arm.close()
    await asyncio.sleep(0.2)
    await arm.open()
    await eventually(arm.state, at_rest)
    assert (await first_value(arm.state)).height_mm == pytest.approx(0.0, abs=0.1)


@pytest.mark.parametrize(("height_mm", "speed_mm_s"), [(math.nan, 50.0), (10.0, math.nan), (10.0, 0.0), (10.0, -5.0)])
async def test_an_invalid_lift_is_refused(arm: Arm, height_mm: float, speed_mm_s: float) -> None:
    with pytest.raises(CommandRefused):
        await arm.lift(height_mm, speed_mm_s)
    assert not (await first_value(arm.state)).moving


@needs("faults")
@pytest.mark.parametrize("kind", ["protective_stop", "emergency_stop"])
async def test_a_safety_stop_is_reported_and_refuses_motion(rig: ArmRig, arm: Arm, kind: str) -> None:
    await arm.lift(rig.far_mm, 100.0)
    await eventually(arm.state, lambda state: state.moving)
    rig.fail(kind)
    state = await eventually(arm.state, lambda state: bool(getattr(state, kind)))
    assert state.protective_stop == (kind == "protective_stop")
    await eventually(arm.state, at_rest)
    with pytest.raises(CommandRefused, match="stop is active"):
        await arm.lift(10.0, 100.0)
    await arm.stop()
    rig.repair(kind)
    await eventually(lambda: _lift_after_reopening(arm), bool)


@needs("faults")
@pytest.mark.parametrize("kind", ["protective_stop", "emergency_stop"])
async def test_an_active_safety_stop_is_reported_after_open(rig: ArmRig, kind: str) -> None:
    rig.fail(kind)
    await rig.arm.open()
    assert getattr(await first_value(rig.arm.state), kind)
    with pytest.raises(CommandRefused, match="stop is active"):
        await rig.arm.lift(10.0, 100.0)
    await rig.arm.stop()
    rig.repair(kind)
    await eventually(lambda: _lift_after_reopening(rig.arm), bool)


@needs("faults")
async def test_an_arm_without_responses_times_out(rig: ArmRig, arm: Arm) -> None:
    rig.fail("timeout")
    assert isinstance(await asyncio.wait_for(_failure(arm), 1.0), DeviceTimeout)
    with pytest.raises(DeviceError):
        await asyncio.wait_for(arm.state(), 1.0)
    rig.repair("timeout")
    await eventually(lambda: _state_after_reopening(arm), bool)


@needs("faults")
async def test_a_lost_arm_is_usable_after_open(rig: ArmRig, arm: Arm) -> None:
    rig.fail("disconnect")
    assert isinstance(await asyncio.wait_for(_failure(arm), 3.0), DeviceLost)
    with pytest.raises(DeviceLost):
        await arm.open()
    rig.repair("disconnect")
    with pytest.raises(DeviceLost):
        await arm.lift(10.0, 50.0)
    await eventually(lambda: _state_after_reopening(arm), bool)
    assert not (await first_value(arm.state)).moving


async def test_an_arm_that_is_not_open_is_lost(rig: ArmRig) -> None:
    with pytest.raises(DeviceLost):
        await rig.arm.state()
    await rig.arm.open()
    await rig.arm.open()
    await rig.arm.state()
    await rig.arm.close()
    await rig.arm.close()
    for command in (rig.arm.state, rig.arm.stop, lambda: rig.arm.lift(1.0, 10.0)):
        with pytest.raises(DeviceLost):
            await command()


async def test_a_cancelled_call_does_no_harm(arm: Arm) -> None:
    for command in (arm.state, arm.stop, lambda: arm.lift(1.0, 10.0)):
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(command(), 0.0005)
        await arm.state()


@guard_mode
async def test_in_guard_mode_a_lift_is_refused(rig: ArmRig) -> None:
    await rig.arm.open()
    with pytest.raises(CommandRefused, match="guard mode"):
        await rig.arm.lift(10.0, 50.0)


@guard_mode
@needs("other program")
async def test_in_guard_mode_it_is_monitored_and_paused_and_never_moved(rig: ArmRig) -> None:
    arm = rig.arm
    await arm.open()
    with pytest.raises(CommandRefused, match="guard mode"):
        await arm.lift(10.0, 50.0)
    await arm.stop()
    rig.move_by_other_program()
    await eventually(arm.state, lambda state: state.moving and state.height_mm > 5.0)
    with pytest.raises(CommandRefused, match="guard mode"):
        await arm.lift(10.0, 50.0)
    assert (await first_value(arm.state)).moving
    await arm.stop()
    await arm.stop()
    paused = await eventually(arm.state, at_rest)
    assert paused.height_mm < rig.far_mm


@guard_mode
@needs("other program")
async def test_in_guard_mode_open_and_close_stop_nothing(rig: ArmRig) -> None:
    arm = rig.arm
    await arm.open()
    rig.move_by_other_program()
    await eventually(arm.state, lambda state: state.moving)
    for _ in range(2):
        await arm.close()
        with pytest.raises(DeviceLost):
            await arm.state()
        await arm.open()
        await eventually(arm.state, lambda state: state.moving)


@guard_mode
@needs("faults")
async def test_in_guard_mode_a_safety_stop_is_reported(rig: ArmRig) -> None:
    await rig.arm.open()
    rig.fail("protective_stop")
    await eventually(rig.arm.state, lambda state: state.protective_stop)
    rig.repair("protective_stop")
    await eventually(rig.arm.state, lambda state: not state.protective_stop)


async def _failure(arm: Arm) -> DeviceError:
    while True:
        try:
            await arm.state()
        except DeviceError as error:
            return error
        await asyncio.sleep(0.005)


async def _state_after_reopening(arm: Arm) -> bool:
    try:
        return bool(await first_value(arm.state))
    except DeviceLost:
        with contextlib.suppress(DeviceLost):
            await arm.open()
    except DeviceTimeout:
        pass
    return False


async def _lift_after_reopening(arm: Arm) -> bool:
    """Lift; a controller needs a new connection after a safety stop, and refuses until the stop is cleared."""
    try:
        return await arm.lift(10.0, 100.0) > 0
    except DeviceLost:
        with contextlib.suppress(DeviceLost):
            await arm.open()
    except CommandRefused:
        pass
    return False
