"""The real driver opens a gripper that is not active by an automatic release, and never activates it for that."""

from __future__ import annotations

import asyncio

import pytest
from robotiq_rig import OBJECT_MM, put, until, until_it_rests, words_written

from slipguard.devices import GripperState
from slipguard.errors import CommandRefused, DeviceError, DeviceTimeout
from slipguard_drivers.robotiq.gripper import RobotiqGripper
from slipguard_drivers.robotiq.registers import MODELS
from slipguard_emulators.robotiq.emulator import RobotiqEmulator

AUTO_RELEASE = "3100 0000 0000"
"""rACT 1, rATR 1, rARD 1 (opening)."""
each_model = pytest.mark.parametrize("emulator", list(MODELS), indirect=True)


def lose_power(emulator: RobotiqEmulator, *, sets_ract: bool = True) -> None:
    emulator.registers.action_after_power_loss = int(sets_ract)
    emulator.registers.lose_power(asyncio.get_running_loop().time())


def width_mm(emulator: RobotiqEmulator) -> float:
    return float(str(emulator.state()["width_mm"]))


async def released(emulator: RobotiqEmulator, gripper: RobotiqGripper) -> GripperState:
    """Release, wait until the jaws rest, and check that they only opened."""
    await gripper.release(60.0)
    before_mm = width_mm(emulator)
    while (state := await gripper.state()).moving:
        assert width_mm(emulator) >= before_mm
        before_mm = width_mm(emulator)
    return state


@each_model
async def test_after_a_loss_of_power_it_opens_slowly_and_only_opens(
    emulator: RobotiqEmulator, held: RobotiqGripper
) -> None:
    lose_power(emulator)
    lost = await held.state()
    assert (lost.active, lost.moving, lost.holding, lost.auto_released) == (False, False, False, False)
    state = await released(emulator, held)
    assert (state.active, state.fault, state.auto_released) == (False, None, True)
    assert state.width_mm - lost.width_mm > 3.0
    assert words_written(emulator) == [AUTO_RELEASE]
    assert emulator.registers.activations == 0
    assert emulator.state()["force_n"] == 0.0


async def test_afterwards_it_grips_only_when_it_was_activated(emulator: RobotiqEmulator, held: RobotiqGripper) -> None:
    lose_power(emulator)
    await released(emulator, held)
    with pytest.raises(CommandRefused, match="slipguard ctl activate"):
        await held.hold(40.0)
    await held.release(85.0)
    assert words_written(emulator) == [AUTO_RELEASE], "it has ended already"
    put(emulator, None)
    await held.activate()
    state = await held.state()
    assert (state.active, state.auto_released) == (True, False)
    put(emulator, OBJECT_MM)
    await held.hold(40.0)
    await until_it_rests(held)
    assert (await held.state()).holding


async def test_in_reset_it_does_not_open_because_that_would_close_it_too(
    emulator: RobotiqEmulator, held: RobotiqGripper
) -> None:
    lose_power(emulator, sets_ract=False)
    assert not (await held.state()).moving
    with pytest.raises(CommandRefused, match="switch its 24 V off and on, which sets the bit, then release again"):
        await held.release(85.0)
    assert words_written(emulator) == []
    lose_power(emulator)
    assert (await released(emulator, held)).auto_released


async def test_a_faulty_gripper_opens_without_an_activation(emulator: RobotiqEmulator, held: RobotiqGripper) -> None:
    emulator.control("gflt 0x0E")
    with pytest.raises(DeviceError, match="overcurrent; if it holds something, support that"):
        await held.hold(80.0)
    state = await released(emulator, held)
    assert (state.active, state.auto_released) == (False, True)
    assert words_written(emulator) == [AUTO_RELEASE]


async def test_one_that_cannot_move_says_so(emulator: RobotiqEmulator, held: RobotiqGripper) -> None:
    emulator.control("gflt 0x0A")
    with pytest.raises(DeviceTimeout, match="does not begin its automatic release"):
        await held.release(85.0)
    assert (await held.state()).width_mm == pytest.approx(OBJECT_MM, abs=0.5)


async def test_a_loss_of_power_ends_an_activation(emulator: RobotiqEmulator, gripper: RobotiqGripper) -> None:
    lose_power(emulator)
    activation = asyncio.ensure_future(gripper.activate())
    await until(lambda: emulator.events("activating"))
    lose_power(emulator)
    with pytest.raises(DeviceTimeout, match="lost power or was reset during its activation"):
        await activation
    assert not (await gripper.state()).moving


@pytest.mark.parametrize("counts", [(3, 222), (13, 235)])
async def test_bare_fingers_that_close_on_nothing_are_recognized_after_any_calibration(
    emulator: RobotiqEmulator, gripper: RobotiqGripper, counts: tuple[int, int]
) -> None:
    emulator.registers.counts = counts
    await gripper.hold(60.0)
    await until_it_rests(gripper)
    state = await gripper.state()
    assert (state.holding, state.closed_on_nothing) == (False, True)
