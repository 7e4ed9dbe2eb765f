"""What `slipguard.devices.Gripper` promises, asked of every gripper there is."""

from __future__ import annotations

import asyncio
import math
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
from gripper_rigs import FakeRig, HardwareRig, Rig, WireRig
from timeouts import eventually

from slipguard.devices import Gripper, GripperState
from slipguard.errors import CommandRefused, DeviceError, DeviceLost, DeviceTimeout

STEP_N = 0.85  # one force count
STEP_MM = 0.38  # one position count


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """A double of each kind; a real gripper only where one is named."""
    if "rig" in metafunc.fixturenames:
        real = ["real"] if metafunc.config.getoption("--gripper") else []
        metafunc.parametrize("rig", ["fake", "wire", *real], indirect=True)


@pytest.fixture
async def rig(request: pytest.FixtureRequest, tmp_path: Path) -> AsyncIterator[Rig]:
    port, with_object = (request.config.getoption(name) for name in ("--gripper", "--gripper-object"))
    if request.param == "real":
        rig: Rig = HardwareRig(port, with_object=with_object)
    else:
        rig = {"fake": FakeRig, "wire": WireRig}[request.param](tmp_path)
    await rig.start()
    yield rig
    await rig.gripper.close()
    await rig.end()


@pytest.fixture
async def gripper(rig: Rig) -> Gripper:
    await rig.gripper.open()
    return rig.gripper


@pytest.fixture
async def held(rig: Rig, gripper: Gripper) -> Gripper:
    rig.put_object()
    await gripper.hold(40.0)
    await eventually(gripper.state, lambda state: state.holding and not state.moving)
    return gripper


async def test_force_limits_are_a_range(gripper: Gripper) -> None:
    low_n, high_n = gripper.force_limits_n
    assert 0 < low_n < high_n


async def test_hold_grips_with_the_force_it_returns(rig: Rig, gripper: Gripper) -> None:
    rig.put_object()
    applied_n = await gripper.hold(40.0)
    assert 40.0 <= applied_n <= 40.0 + STEP_N
    state = await eventually(gripper.state, lambda state: state.holding and not state.moving)
    assert state.active
    assert state.fault is None
    assert not state.closed_on_nothing
    assert state.force_n == pytest.approx(applied_n)
    assert rig.pressed_with_n() == pytest.approx(applied_n)


async def test_a_lower_force_changes_nothing(rig: Rig, held: Gripper) -> None:
    before_n = rig.pressed_with_n()
    assert await held.hold(25.0) == pytest.approx(before_n)
    await asyncio.sleep(0.1)
    assert (await held.state()).holding
    assert rig.pressed_with_n() == pytest.approx(before_n)


async def test_a_higher_force_really_tightens(rig: Rig, held: Gripper) -> None:
    applied_n = await held.hold(80.0)
    assert 80.0 <= applied_n <= 80.0 + STEP_N

    async def pressed_with_n() -> float:
        return rig.pressed_with_n()

    await eventually(pressed_with_n, lambda force_n: abs(force_n - applied_n) < 0.01)
    await eventually(held.state, lambda state: state.holding and not state.moving)
    assert await held.hold(80.0) == pytest.approx(applied_n), "the same command again"


async def test_forces_beyond_the_limits_become_the_nearest(rig: Rig, held: Gripper) -> None:
    assert await held.hold(10_000.0) == pytest.approx(held.force_limits_n[1])


@pytest.mark.parametrize("force_n", [math.nan, math.inf, -1.0])
async def test_a_force_that_makes_no_sense_is_refused(held: Gripper, force_n: float) -> None:
    with pytest.raises(CommandRefused):
        await held.hold(force_n)
    assert (await held.state()).holding


async def test_closing_on_nothing_is_told(gripper: Gripper) -> None:
    await gripper.hold(30.0)
    state = await eventually(gripper.state, lambda state: state.closed_on_nothing)
    assert not state.holding
    assert state.width_mm < 2.0


async def test_move_goes_to_the_width_it_returns(gripper: Gripper) -> None:
    goal_mm = await gripper.move(50.0, 30.0)
    assert goal_mm == pytest.approx(50.0, abs=STEP_MM)
    await eventually(gripper.state, lambda state: abs(state.width_mm - goal_mm) < STEP_MM and not state.moving)


async def test_hold_closes_after_a_move_with_more_force(rig: Rig, gripper: Gripper) -> None:
    rig.put_object()
    await gripper.move(80.0, 60.0)
    await eventually(gripper.state, lambda state: not state.moving)
    await gripper.hold(30.0)
    await eventually(gripper.state, lambda state: state.holding)


@pytest.mark.parametrize("width_mm", [-1.0, math.inf, math.nan])
async def test_a_width_that_makes_no_sense_is_refused(gripper: Gripper, width_mm: float) -> None:
    with pytest.raises(CommandRefused):
        await gripper.move(width_mm, 30.0)
    with pytest.raises(CommandRefused):
        await gripper.release(width_mm)


async def test_a_release_beyond_the_stroke_opens_as_far_as_it_goes(rig: Rig, held: Gripper) -> None:
    await held.release(300.0)
    state = await eventually(held.state, lambda state: not state.holding and not state.moving)
    assert state.width_mm > 84.0


async def test_move_is_refused_while_an_object_is_held(rig: Rig, held: Gripper) -> None:
    before_n = rig.pressed_with_n()
    with pytest.raises(CommandRefused, match="release"):
        await held.move(80.0, 30.0)
    await asyncio.sleep(0.1)
    assert (await held.state()).holding
    assert rig.pressed_with_n() == pytest.approx(before_n)


async def test_a_move_outwards_is_refused_while_the_fingers_close(rig: Rig, gripper: Gripper) -> None:
    """They may have met something a moment ago, and would let it go."""
    rig.put_object()
    await gripper.hold(60.0)
    with pytest.raises(CommandRefused):
        await gripper.move(80.0, 30.0)
    await eventually(gripper.state, lambda state: state.holding and not state.moving)


async def test_while_it_tightens_it_is_said_to_hold(rig: Rig, held: Gripper) -> None:
    await held.hold(200.0)
    while (state := await held.state()).moving:
        assert state.holding
    assert state.holding


async def test_a_closing_that_is_halted_stays_where_it_is(rig: Rig, gripper: Gripper) -> None:
    rig.put_object()
    await gripper.hold(60.0)
    await gripper.halt()
    halted = await gripper.state()
    assert not halted.moving
    assert not halted.closed_on_nothing
    assert halted.force_n == 0.0, "what it has reached is not known"
    assert halted.width_mm > 1.0
    await asyncio.sleep(0.2)
    later = await gripper.state()
    assert later.width_mm == pytest.approx(halted.width_mm, abs=STEP_MM)
    assert not later.moving
    await gripper.hold(40.0)
    state = await eventually(gripper.state, lambda state: state.holding and not state.moving)
    assert state.force_n >= 40.0


async def test_a_tightening_that_is_halted_keeps_the_force_it_has(rig: Rig, held: Gripper) -> None:
    before_n = rig.pressed_with_n()
    await held.hold(200.0)
    await held.halt()
    halted_n = rig.pressed_with_n()
    assert before_n <= halted_n < 200.0
    await asyncio.sleep(0.3)
    assert rig.pressed_with_n() == pytest.approx(halted_n)
    state = await held.state()
    assert state.holding
    assert not state.moving
    assert state.force_n <= held.force_limits_n[0], "what it has reached is not known"
    assert await held.hold(220.0) >= 220.0
    await eventually(held.state, lambda state: state.holding and not state.moving)
    assert rig.pressed_with_n() == pytest.approx(220.0, abs=STEP_N)


async def test_halting_what_rests_changes_nothing(rig: Rig, held: Gripper) -> None:
    before = await held.state()
    await held.halt()
    after = await held.state()
    assert (after.holding, after.moving, after.force_n, after.width_mm) == (
        before.holding, before.moving, before.force_n, before.width_mm,
    )  # fmt: skip


async def test_release_lets_go(rig: Rig, held: Gripper) -> None:
    await held.release(85.0)
    await eventually(held.state, lambda state: state.width_mm > 84.0 and not state.holding)
    assert rig.pressed_with_n() == 0.0


async def test_after_a_release_a_lower_force_holds(rig: Rig, held: Gripper) -> None:
    await held.release(85.0)
    await eventually(held.state, lambda state: state.width_mm > 84.0)
    assert await held.hold(25.0) < 40.0
    await eventually(held.state, lambda state: state.holding and not state.moving)
    assert rig.pressed_with_n() == pytest.approx(25.0, abs=STEP_N)


async def test_a_restart_adopts_the_grip(rig: Rig, held: Gripper) -> None:
    before_n = rig.pressed_with_n()
    await held.close()
    rig.gripper = rig.again()
    await rig.gripper.open()
    state = await rig.gripper.state()
    assert state.holding
    assert rig.pressed_with_n() == pytest.approx(before_n)
    with pytest.raises(CommandRefused):
        await rig.gripper.move(80.0, 30.0)
    assert await rig.gripper.hold(90.0) >= 90.0
    await eventually(rig.gripper.state, lambda state: state.holding and not state.moving)
    assert rig.pressed_with_n() == pytest.approx(90.0, abs=STEP_N)


async def test_before_open_and_after_close_it_is_lost(rig: Rig) -> None:
    with pytest.raises(DeviceLost):
        await rig.gripper.state()
    await rig.gripper.open()
    await rig.gripper.open()
    await rig.gripper.state()
    await rig.gripper.close()
    await rig.gripper.close()
    with pytest.raises(DeviceLost):
        await rig.gripper.hold(30.0)


async def test_a_lost_gripper_keeps_its_grip_and_comes_back_with_open(rig: Rig, held: Gripper) -> None:
    rig.fail("disconnect")
    with pytest.raises(DeviceLost):
        await asyncio.wait_for(_ask_until_it_fails(held), 2.0)
    with pytest.raises(DeviceLost):
        await held.open()
    rig.repair("disconnect")
    with pytest.raises(DeviceLost):
        await held.state()
    await held.open()
    assert (await held.state()).holding


async def test_a_silent_gripper_times_out_and_may_be_asked_again(rig: Rig, held: Gripper) -> None:
    rig.fail("timeout")
    for _ in range(10):
        with pytest.raises(DeviceTimeout):
            await asyncio.wait_for(held.state(), 1.0)
    with pytest.raises(DeviceTimeout):
        await held.hold(60.0)
    rig.repair("timeout")
    assert (await held.state()).holding
    assert await held.hold(60.0) >= 60.0


async def test_a_fault_is_told_in_words_and_stops_commands(rig: Rig, held: Gripper) -> None:
    rig.fail("fault")
    fault = (await held.state()).fault
    assert fault
    assert len(fault) > 5
    with pytest.raises(DeviceError, match=fault):
        await held.hold(60.0)
    rig.repair("fault")
    assert (await held.state()).fault is None
    assert await held.hold(60.0) >= 60.0


async def test_many_callers_get_their_own_answers(rig: Rig, held: Gripper) -> None:
    answers = await asyncio.gather(held.hold(50.0), *(held.state() for _ in range(8)), held.hold(70.0))
    assert answers[0] == pytest.approx(50.0, abs=STEP_N)
    assert answers[-1] == pytest.approx(70.0, abs=STEP_N)
    assert all(isinstance(state, GripperState) for state in answers[1:-1])


async def test_a_caller_that_gives_up_upsets_nobody(rig: Rig, held: Gripper) -> None:
    for command in (held.state, lambda: held.hold(55.0)):
        task = asyncio.ensure_future(command())
        await asyncio.sleep(0.002)
        task.cancel()
        await asyncio.wait([task])
        state = await held.state()
        assert state.holding
        assert state.active


async def _ask_until_it_fails(gripper: Gripper) -> None:
    while True:
        await gripper.state()
