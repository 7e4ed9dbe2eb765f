"""The contract of `slipguard.devices.Gripper`, checked on every gripper."""

from __future__ import annotations

import asyncio
import math
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
from gripper_rigs import GripperRig, abilities, make_rig
from rig import needs, parametrize_rig
from timeouts import eventually

from slipguard.devices import Gripper, GripperState
from slipguard.errors import CommandRefused, DeviceError, DeviceLost, DeviceTimeout

WEAK, FIRM, STRONG = 0.025, 0.1, 0.85
"""Forces as a share of the range: 25, 41 and 203 N on a 2F-85."""


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    parametrize_rig(metafunc, abilities(metafunc.config), fixture_needs={"held": "object"})


@pytest.fixture
async def rig(request: pytest.FixtureRequest, tmp_path: Path) -> AsyncIterator[GripperRig]:
    rig = make_rig(request.param, tmp_path, request.config)
    await rig.start()
    yield rig
    await rig.gripper.close()
    await rig.stop()


@pytest.fixture
async def gripper(rig: GripperRig) -> Gripper:
    await rig.gripper.open()
    return rig.gripper


@pytest.fixture
async def held(rig: GripperRig, gripper: Gripper) -> Gripper:
    rig.put_object()
    await gripper.hold(rig.force(FIRM))
    await eventually(gripper.state, lambda state: state.holding and not state.moving)
    return gripper


def check_pressed(rig: GripperRig, expected_n: float | None, tolerance_n: float = 1e-6) -> None:
    """Compare the force on the object with what the driver said, where the rig knows it."""
    if (pressed_n := rig.pressed_n()) is not None and expected_n is not None:
        assert pressed_n == pytest.approx(expected_n, abs=tolerance_n)


async def test_force_limits_are_a_range(gripper: Gripper) -> None:
    low_n, high_n = gripper.force_limits_n
    assert 0 < low_n < high_n


async def test_an_active_gripper_is_not_activated_again(gripper: Gripper) -> None:
    before = await gripper.state()
    assert before.active
    with pytest.raises(CommandRefused):
        await gripper.activate()
    after = await gripper.state()
    assert (after.active, after.moving, after.width_mm) == (True, False, before.width_mm)


@needs("object")
async def test_hold_grips_with_the_force_it_returns(rig: GripperRig, gripper: Gripper) -> None:
    rig.put_object()
    force_n = rig.force(FIRM)
    applied_n = await gripper.hold(force_n)
    assert force_n <= applied_n <= force_n + rig.step_n
    state = await eventually(gripper.state, lambda state: state.holding and not state.moving)
    assert state.active
    assert state.fault is None
    assert not state.closed_on_nothing
    assert state.force_n == pytest.approx(applied_n)
    check_pressed(rig, applied_n)


async def test_a_lower_force_changes_nothing(rig: GripperRig, held: Gripper) -> None:
    before_n = (await held.state()).force_n
    check_pressed(rig, before_n)
    assert await held.hold(rig.force(WEAK)) == pytest.approx(before_n)
    await asyncio.sleep(0.1)
    assert (await held.state()).holding
    check_pressed(rig, before_n)


async def test_a_higher_force_really_tightens(rig: GripperRig, held: Gripper) -> None:
    force_n = rig.force(0.3)
    applied_n = await held.hold(force_n)
    assert force_n <= applied_n <= force_n + rig.step_n

    async def pressed_n() -> float | None:
        return rig.pressed_n()

    await eventually(pressed_n, lambda pressed_n: pressed_n is None or abs(pressed_n - applied_n) < 0.01)
    await eventually(held.state, lambda state: state.holding and not state.moving)
    assert await held.hold(force_n) == pytest.approx(applied_n), "the same command again"


async def test_a_force_beyond_the_limits_becomes_the_limit(held: Gripper) -> None:
    assert await held.hold(10_000.0) == pytest.approx(held.force_limits_n[1])


@pytest.mark.parametrize("force_n", [math.nan, math.inf, -1.0])
async def test_an_invalid_force_is_refused(held: Gripper, force_n: float) -> None:
    with pytest.raises(CommandRefused):
        await held.hold(force_n)
    assert (await held.state()).holding


@needs("no object")
async def test_closing_on_nothing_is_reported(rig: GripperRig, gripper: Gripper) -> None:
    await gripper.hold(rig.force(WEAK))
    state = await eventually(gripper.state, lambda state: state.closed_on_nothing)
    assert not state.holding
    assert state.width_mm < 2.0


@needs("no object")
async def test_move_goes_to_the_width_it_returns(rig: GripperRig, gripper: Gripper) -> None:
    width_mm = round(0.6 * rig.open_mm, 1)
    goal_mm = await gripper.move(width_mm, rig.force(WEAK))
    assert goal_mm == pytest.approx(width_mm, abs=rig.step_mm)
    await eventually(gripper.state, lambda state: abs(state.width_mm - goal_mm) < rig.step_mm and not state.moving)


@needs("object")
async def test_hold_closes_after_a_move_with_more_force(rig: GripperRig, gripper: Gripper) -> None:
    rig.put_object()
    await gripper.move(0.94 * rig.open_mm, rig.force(0.2))
    await eventually(gripper.state, lambda state: not state.moving)
    await gripper.hold(rig.force(WEAK))
    await eventually(gripper.state, lambda state: state.holding)


@pytest.mark.parametrize("width_mm", [-1.0, math.inf, math.nan])
async def test_an_invalid_width_is_refused(rig: GripperRig, gripper: Gripper, width_mm: float) -> None:
    with pytest.raises(CommandRefused):
        await gripper.move(width_mm, rig.force(WEAK))
    with pytest.raises(CommandRefused):
        await gripper.release(width_mm)


async def test_a_release_beyond_the_stroke_opens_fully(rig: GripperRig, held: Gripper) -> None:
    await held.release(300.0)
    state = await eventually(held.state, lambda state: not state.holding and not state.moving)
    assert state.width_mm > rig.open_mm - 1.0


async def test_move_is_refused_while_an_object_is_held(rig: GripperRig, held: Gripper) -> None:
    before_n = rig.pressed_n()
    with pytest.raises(CommandRefused, match="release"):
        await held.move(0.94 * rig.open_mm, rig.force(WEAK))
    await asyncio.sleep(0.1)
    assert (await held.state()).holding
    check_pressed(rig, before_n)


@needs("object")
async def test_opening_is_refused_while_the_fingers_close(rig: GripperRig, gripper: Gripper) -> None:
    """They may have gripped something a moment ago, which would fall."""
    rig.put_object()
    await gripper.hold(rig.force(0.2))
    with pytest.raises(CommandRefused):
        await gripper.move(0.94 * rig.open_mm, rig.force(WEAK))
    await eventually(gripper.state, lambda state: state.holding and not state.moving)


async def test_while_it_tightens_it_is_holding(rig: GripperRig, held: Gripper) -> None:
    await held.hold(rig.force(STRONG))
    while (state := await held.state()).moving:
        assert state.holding
    assert state.holding


@needs("object")
async def test_an_interrupted_closing_stays_in_place(rig: GripperRig, gripper: Gripper) -> None:
    rig.put_object()
    await gripper.hold(rig.force(0.2))
    await gripper.halt()
    halted = await gripper.state()
    assert not halted.moving
    assert not halted.closed_on_nothing
    assert halted.force_n == 0.0, "the force that was reached is unknown"
    assert halted.width_mm > 1.0
    await asyncio.sleep(0.2)
    later = await gripper.state()
    assert later.width_mm == pytest.approx(halted.width_mm, abs=rig.step_mm)
    assert not later.moving
    await gripper.hold(rig.force(FIRM))
    state = await eventually(gripper.state, lambda state: state.holding and not state.moving)
    assert state.force_n >= rig.force(FIRM)


async def test_an_interrupted_tightening_keeps_its_force(rig: GripperRig, held: Gripper) -> None:
    before_n = rig.pressed_n()
    await held.hold(rig.force(STRONG))
    await held.halt()
    halted_n = rig.pressed_n()
    if before_n is not None and halted_n is not None:
        assert before_n <= halted_n < rig.force(STRONG)
    await asyncio.sleep(0.3)
    check_pressed(rig, halted_n)
    state = await held.state()
    assert state.holding
    assert not state.moving
    assert state.force_n <= held.force_limits_n[0], "the force that was reached is unknown"
    stronger_n = rig.force(0.93)
    assert await held.hold(stronger_n) >= stronger_n
    await eventually(held.state, lambda state: state.holding and not state.moving)
    check_pressed(rig, stronger_n, rig.step_n)


async def test_halting_a_gripper_at_rest_changes_nothing(rig: GripperRig, held: Gripper) -> None:
    before = await held.state()
    await held.halt()
    after = await held.state()
    assert (after.holding, after.moving, after.force_n, after.width_mm) == (
        before.holding, before.moving, before.force_n, before.width_mm,
    )  # fmt: skip


async def test_release_opens_the_fingers(rig: GripperRig, held: Gripper) -> None:
    await held.release(rig.open_mm)
    await eventually(held.state, lambda state: state.width_mm > rig.open_mm - 1.0 and not state.holding)
    check_pressed(rig, 0.0)


@needs("no object")
async def test_a_release_opens_by_some_millimeters_in_any_case(rig: GripperRig, held: Gripper) -> None:
    before_mm = (await held.state()).width_mm
    await held.release(before_mm - 10.0)
    await eventually(held.state, lambda state: state.width_mm > before_mm + 2.0 and not state.holding)
    check_pressed(rig, 0.0)


@needs("faults")
async def test_a_gripper_that_is_not_active_opens_without_closing_first(rig: GripperRig, held: Gripper) -> None:
    rig.lose_power()
    lost = await held.state()
    assert (lost.active, lost.holding, lost.moving) == (False, False, False)
    await held.release(0.5 * rig.open_mm)
    width_mm, pressed_n = lost.width_mm, rig.pressed_n() or 0.0
    while not (state := await held.state()).auto_released:
        assert state.width_mm >= width_mm
        assert (rig.pressed_n() or 0.0) <= pressed_n
        width_mm, pressed_n = state.width_mm, rig.pressed_n() or 0.0
    assert not state.moving
    assert not state.active
    assert state.width_mm > lost.width_mm + 2.0
    check_pressed(rig, 0.0)
    with pytest.raises(CommandRefused):
        await held.hold(rig.force(FIRM))


async def test_after_a_release_a_lower_force_holds(rig: GripperRig, held: Gripper) -> None:
    await held.release(rig.open_mm)
    await eventually(held.state, lambda state: state.width_mm > rig.open_mm - 1.0)
    assert await held.hold(rig.force(WEAK)) < rig.force(FIRM)
    await eventually(held.state, lambda state: state.holding and not state.moving)
    check_pressed(rig, rig.force(WEAK), rig.step_n)


async def test_a_restart_adopts_the_grip(rig: GripperRig, held: Gripper) -> None:
    before_n = rig.pressed_n()
    await held.close()
    rig.gripper = rig.new_driver()
    await rig.gripper.open()
    state = await rig.gripper.state()
    assert state.holding
    check_pressed(rig, before_n)
    with pytest.raises(CommandRefused):
        await rig.gripper.move(0.94 * rig.open_mm, rig.force(WEAK))
    stronger_n = rig.force(0.33)
    assert await rig.gripper.hold(stronger_n) >= stronger_n
    await eventually(rig.gripper.state, lambda state: state.holding and not state.moving)
    check_pressed(rig, stronger_n, rig.step_n)


async def test_a_gripper_that_is_not_open_is_lost(rig: GripperRig) -> None:
    with pytest.raises(DeviceLost):
        await rig.gripper.state()
    await rig.gripper.open()
    await rig.gripper.open()
    await rig.gripper.state()
    await rig.gripper.close()
    await rig.gripper.close()
    with pytest.raises(DeviceLost):
        await rig.gripper.hold(rig.force(WEAK))


@needs("faults")
async def test_a_lost_gripper_keeps_its_grip_and_is_usable_after_open(rig: GripperRig, held: Gripper) -> None:
    rig.fail("disconnect")
    with pytest.raises(DeviceLost):
        await asyncio.wait_for(_poll_until_error(held), 2.0)
    with pytest.raises(DeviceLost):
        await held.open()
    rig.repair("disconnect")
    with pytest.raises(DeviceLost):
        await held.state()
    await held.open()
    assert (await held.state()).holding


@needs("faults")
async def test_a_silent_gripper_times_out_and_is_usable_afterwards(rig: GripperRig, held: Gripper) -> None:
    rig.fail("timeout")
    for _ in range(10):
        with pytest.raises(DeviceTimeout):
            await asyncio.wait_for(held.state(), 1.0)
    with pytest.raises(DeviceTimeout):
        await held.hold(rig.force(0.2))
    rig.repair("timeout")
    assert (await held.state()).holding
    assert await held.hold(rig.force(0.2)) >= rig.force(0.2)


@needs("faults")
async def test_a_fault_is_described_and_stops_commands(rig: GripperRig, held: Gripper) -> None:
    rig.fail("fault")
    await asyncio.sleep(rig.status_age_s)
    fault = (await held.state()).fault
    assert fault
    assert len(fault) > 5
    with pytest.raises(DeviceError, match=fault):
        await held.hold(rig.force(0.2))
    rig.repair("fault")
    await asyncio.sleep(rig.status_age_s)
    assert (await held.state()).fault is None
    assert await held.hold(rig.force(0.2)) >= rig.force(0.2)


async def test_concurrent_callers_get_their_own_responses(rig: GripperRig, held: Gripper) -> None:
    first_n, last_n = rig.force(0.15), rig.force(0.25)
    responses = await asyncio.gather(held.hold(first_n), *(held.state() for _ in range(8)), held.hold(last_n))
    assert responses[0] == pytest.approx(first_n, abs=rig.step_n)
    assert responses[-1] == pytest.approx(last_n, abs=rig.step_n)
    assert all(isinstance(state, GripperState) for state in responses[1:-1])


async def test_a_cancelled_call_does_no_harm(rig: GripperRig, held: Gripper) -> None:
    for command in (held.state, lambda: held.hold(rig.force(0.17))):
        task = asyncio.ensure_future(command())
        await asyncio.sleep(0.002)
        task.cancel()
        await asyncio.wait([task])
        state = await held.state()
        assert state.holding
        assert state.active


async def _poll_until_error(gripper: Gripper) -> None:
    while True:
        await gripper.state()
