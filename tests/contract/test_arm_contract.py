"""What `slipguard.devices.Arm` promises, asked of every arm there is."""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections.abc import AsyncIterator

import pytest
from arm_rigs import Rig, kinds, rig_of
from timeouts import answer_of, eventually

from slipguard.devices import Arm, ArmState
from slipguard.errors import CommandRefused, DeviceError, DeviceLost, DeviceTimeout

BOTH_SERIES = {
    "test_a_lift_starts_and_does_not_wait",
    "test_a_motion_under_way_is_slowed_and_turned_round_by_another",
    "test_stop_ends_a_motion_and_may_come_at_any_time",
    "test_a_safety_stop_is_seen_and_refuses_motion",
    "test_in_guard_mode_it_is_watched_and_paused_and_never_moved",
}
"""Asked of the faster controllers too; the rest does not depend on the rate."""


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    both = metafunc.function.__name__ in BOTH_SERIES
    for fixture in ("rig", "guard_rig"):
        if fixture in metafunc.fixturenames:
            metafunc.parametrize(fixture, kinds(metafunc.config, both_series=both), indirect=True)


@pytest.fixture
async def rig(request: pytest.FixtureRequest) -> AsyncIterator[Rig]:
    rig = rig_of(request.param, "lift", request.config)
    await rig.start()
    yield rig
    await rig.arm.close()
    await rig.arm.close()
    await rig.end()


@pytest.fixture
async def guard_rig(request: pytest.FixtureRequest) -> AsyncIterator[Rig]:
    rig = rig_of(request.param, "guard", request.config)
    await rig.start()
    yield rig
    await rig.arm.close()
    await rig.arm.close()
    await rig.end()


@pytest.fixture
async def arm(rig: Rig) -> Arm:
    await rig.arm.open()
    return rig.arm


def at_rest(state: ArmState) -> bool:
    return not state.moving and state.speed_mm_s == pytest.approx(0.0, abs=0.5)


async def test_it_rests_at_height_zero_where_it_was_found(rig: Rig, arm: Arm) -> None:
    assert (await answer_of(arm.state)).height_mm == pytest.approx(0.0, abs=0.1)
    await arm.lift(10.0, 200.0)
    await eventually(arm.state, lambda state: state.height_mm > 9.9 and at_rest(state))
    await arm.close()
    await arm.open()
    assert (await answer_of(arm.state)).height_mm == pytest.approx(0.0, abs=0.1)


async def test_a_lift_starts_and_does_not_wait(arm: Arm) -> None:
    before_s = asyncio.get_running_loop().time()
    assert await arm.lift(30.0, 100.0) == pytest.approx(100.0)
    assert asyncio.get_running_loop().time() - before_s < 0.2, "30 mm at 100 mm/s take 0.38 s"
    await eventually(arm.state, lambda state: state.moving and state.speed_mm_s > 0)
    await eventually(arm.state, lambda state: at_rest(state) and state.height_mm == pytest.approx(30.0, abs=0.2))
    await arm.lift(-20.0, 100.0)
    await eventually(arm.state, lambda state: at_rest(state) and state.height_mm == pytest.approx(10.0, abs=0.2))


async def test_a_speed_beyond_its_limit_is_cut_and_told(arm: Arm) -> None:
    assert 0 < await arm.lift(5.0, 1e6) <= 1000.0


async def test_a_motion_under_way_is_slowed_and_turned_round_by_another(rig: Rig, arm: Arm) -> None:
    await arm.lift(rig.far_mm, 150.0)
    await eventually(arm.state, lambda state: state.speed_mm_s > 100.0)
    assert await arm.lift(20.0, 20.0) == pytest.approx(20.0)
    await eventually(arm.state, lambda state: 15.0 < state.speed_mm_s < 25.0)
    await arm.lift(-10.0, 100.0)
    await eventually(arm.state, lambda state: state.speed_mm_s < -10.0)
    stopped = await eventually(arm.state, at_rest)
    assert stopped.height_mm < rig.far_mm / 2


async def test_stop_ends_a_motion_and_may_come_at_any_time(rig: Rig, arm: Arm) -> None:
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
    assert (await answer_of(arm.state)).height_mm == pytest.approx(stopped.height_mm, abs=0.1)


async def test_close_stops_the_arm(rig: Rig, arm: Arm) -> None:
    await arm.lift(rig.far_mm, 150.0)
    await eventually(arm.state, lambda state: state.moving)
    await arm.close()
    await asyncio.sleep(0.2)
    await arm.open()
    await eventually(arm.state, at_rest)
    assert (await answer_of(arm.state)).height_mm == pytest.approx(0.0, abs=0.1)


@pytest.mark.parametrize(("height_mm", "speed_mm_s"), [(math.nan, 50.0), (10.0, math.nan), (10.0, 0.0), (10.0, -5.0)])
async def test_a_lift_that_makes_no_sense_is_refused(arm: Arm, height_mm: float, speed_mm_s: float) -> None:
    with pytest.raises(CommandRefused):
        await arm.lift(height_mm, speed_mm_s)
    assert not (await answer_of(arm.state)).moving


@pytest.mark.parametrize("kind", ["protective_stop", "emergency_stop"])
async def test_a_safety_stop_is_seen_and_refuses_motion(rig: Rig, arm: Arm, kind: str) -> None:
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
    await eventually(lambda: _lift_opening_again(arm), bool)


@pytest.mark.parametrize("kind", ["protective_stop", "emergency_stop"])
async def test_a_safety_stop_is_seen_by_who_comes_later(rig: Rig, kind: str) -> None:
    rig.fail(kind)
    await rig.arm.open()
    assert getattr(await answer_of(rig.arm.state), kind)
    with pytest.raises(CommandRefused, match="stop is active"):
        await rig.arm.lift(10.0, 100.0)
    await rig.arm.stop()
    rig.repair(kind)
    await eventually(lambda: _lift_opening_again(rig.arm), bool)


async def test_an_arm_that_falls_silent_times_out(rig: Rig, arm: Arm) -> None:
    rig.fail("timeout")
    assert isinstance(await asyncio.wait_for(_failure(arm), 1.0), DeviceTimeout)
    with pytest.raises(DeviceError):
        await asyncio.wait_for(arm.state(), 1.0)
    rig.repair("timeout")
    await eventually(lambda: _state_opening_again(arm), bool)


async def test_a_lost_arm_comes_back_with_open(rig: Rig, arm: Arm) -> None:
    rig.fail("disconnect")
    assert isinstance(await asyncio.wait_for(_failure(arm), 3.0), DeviceLost)
    with pytest.raises(DeviceLost):
        await arm.open()
    rig.repair("disconnect")
    with pytest.raises(DeviceLost):
        await arm.lift(10.0, 50.0)
    await eventually(lambda: _state_opening_again(arm), bool)
    assert not (await answer_of(arm.state)).moving


async def test_before_open_and_after_close_it_is_lost(rig: Rig) -> None:
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


async def test_a_caller_that_gives_up_upsets_nobody(arm: Arm) -> None:
    for command in (arm.state, arm.stop, lambda: arm.lift(1.0, 10.0)):
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(command(), 0.0005)
        await arm.state()


async def test_in_guard_mode_it_is_watched_and_paused_and_never_moved(guard_rig: Rig) -> None:
    arm = guard_rig.arm
    await arm.open()
    with pytest.raises(CommandRefused, match="guard mode"):
        await arm.lift(10.0, 50.0)
    await arm.stop()
    guard_rig.somebody_moves_it()
    await eventually(arm.state, lambda state: state.moving and state.height_mm > 5.0)
    with pytest.raises(CommandRefused, match="guard mode"):
        await arm.lift(10.0, 50.0)
    assert (await answer_of(arm.state)).moving
    await arm.stop()
    await arm.stop()
    paused = await eventually(arm.state, at_rest)
    assert paused.height_mm < guard_rig.far_mm


async def test_in_guard_mode_coming_and_going_stops_nothing(guard_rig: Rig) -> None:
    arm = guard_rig.arm
    await arm.open()
    guard_rig.somebody_moves_it()
    await eventually(arm.state, lambda state: state.moving)
    for _ in range(2):
        await arm.close()
        with pytest.raises(DeviceLost):
            await arm.state()
        await arm.open()
        await eventually(arm.state, lambda state: state.moving)


async def test_in_guard_mode_a_safety_stop_is_seen(guard_rig: Rig) -> None:
    await guard_rig.arm.open()
    guard_rig.fail("protective_stop")
    await eventually(guard_rig.arm.state, lambda state: state.protective_stop)
    guard_rig.repair("protective_stop")
    await eventually(guard_rig.arm.state, lambda state: not state.protective_stop)


async def _failure(arm: Arm) -> DeviceError:
    while True:
        try:
            await arm.state()
        except DeviceError as error:
            return error
        await asyncio.sleep(0.005)


async def _state_opening_again(arm: Arm) -> bool:
    try:
        return bool(await answer_of(arm.state))
    except DeviceLost:
        with contextlib.suppress(DeviceLost):
            await arm.open()
    except DeviceTimeout:
        pass
    return False


async def _lift_opening_again(arm: Arm) -> bool:
    """A controller needs a new connection after a safety stop; a stop not yet cleared refuses."""
    try:
        return await arm.lift(10.0, 100.0) > 0
    except DeviceLost:
        with contextlib.suppress(DeviceLost):
            await arm.open()
    except CommandRefused:
        pass
    return False
