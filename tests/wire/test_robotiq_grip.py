"""The real gripper driver alone moves fingers: activation, tightening, and what it refuses while it holds."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest
from robotiq_rig import each_model, put, quick, settings, soon_s, until, until_it_rests, words_written

from slipguard.devices import DriverContext
from slipguard.errors import CommandRefused, DeviceError, DeviceLost, DeviceTimeout
from slipguard_drivers.robotiq import gripper as driver
from slipguard_drivers.robotiq.gripper import RobotiqGripper
from slipguard_drivers.robotiq.modbus import ModbusConnection
from slipguard_drivers.robotiq.registers import MODELS
from slipguard_emulators.robotiq.emulator import RobotiqEmulator


async def test_the_bytes_on_the_line_are_the_manuals(emulator: RobotiqEmulator) -> None:
    said: list[bytes] = []
    emulator._port._on_bytes = said.append
    line = ModbusConnection("gripper", emulator.address, 9, 0.05)
    await line.connect()
    for ask in (line.write(0x03E8, [0x0900, 0x00FF, 0xFFFF], soon_s()), line.read(0x07D0, 3, soon_s())):
        line._out_of_sync = False
        with pytest.raises(DeviceTimeout):
            await ask
    assert b"".join(said) == bytes.fromhex("09 10 03E8 0003 06 0900 00FF FFFF 4229 09 04 07D0 0003 B1CE")
    line.close()


async def test_it_is_activated_on_request_only(tmp_path: Path) -> None:
    emulator = quick(tmp_path)
    await emulator.start()
    gripper = RobotiqGripper(settings(emulator), DriverContext("gripper"))
    await gripper.open()
    state = await gripper.state()
    assert (state.active, state.moving, state.fault) == (False, False, None), "gACT is 1 after power-on: not activating"
    for command in (gripper.hold(40.0), gripper.move(50.0, 40.0)):
        with pytest.raises(CommandRefused, match="run `slipguard ctl activate`"):
            await command
    assert words_written(emulator) == []
    await gripper.activate()
    state = await gripper.state()
    assert state.active
    assert state.width_mm == pytest.approx(85.0, abs=4.0), "the counts are calibrated anew at each activation"
    assert emulator.registers.activations == 1
    with pytest.raises(CommandRefused, match="already activated"):
        await gripper.activate()
    await gripper.close()
    await emulator.stop()


async def test_an_activation_is_refused_while_an_object_is_held(
    emulator: RobotiqEmulator, held: RobotiqGripper
) -> None:
    emulator.control("gflt 0x0E")
    with pytest.raises(CommandRefused, match="an object is held"):
        await held.activate()
    assert words_written(emulator) == []


@pytest.mark.realtime
async def test_closing_the_connection_does_not_wait_for_an_activation(tmp_path: Path) -> None:
    emulator = quick(tmp_path, quick=1.0)
    await emulator.start()
    gripper = RobotiqGripper(settings(emulator), DriverContext("gripper"))
    await gripper.open()
    activation = asyncio.ensure_future(gripper.activate())
    await asyncio.sleep(0.2)
    await asyncio.wait_for(gripper.close(), 0.3)
    with pytest.raises(DeviceLost, match="repeat the command"):
        await activation
    await emulator.stop()


@pytest.mark.parametrize("fault", ["unplug", "silence"])
async def test_an_activation_that_fails_late_may_still_move_the_jaws_and_says_so(
    tmp_path: Path, fault: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(driver, "ACTIVATION_TIMEOUT_S", 0.5)
    emulator = quick(tmp_path, quick=1.0)
    await emulator.start()
    gripper = RobotiqGripper(settings(emulator), DriverContext("gripper"))
    await gripper.open()
    activation = asyncio.ensure_future(gripper.activate())
    await until(lambda: emulator.events("activating"))
    emulator.control(f"fault {fault}")
    for command in (activation, gripper.state(), gripper.open()):
        with pytest.raises(DeviceError, match="may still move the jaws fully, until it responds again") as caught:
            await asyncio.wait_for(command, 15.0)
        assert str(caught.value).count("may still move") == 1
    assert emulator.state()["stage"] != "off", "it goes on alone"
    emulator.control(f"clear {fault}")
    await gripper.open()
    while not (state := await gripper.state()).active:
        assert state.moving, "what moves is reported as moving"
        await asyncio.sleep(0.05)
    assert not (await gripper.state()).moving
    await gripper.close()
    await emulator.stop()


async def test_a_write_without_a_response_may_have_moved_the_jaws_and_says_so(
    emulator: RobotiqEmulator, gripper: RobotiqGripper
) -> None:
    await gripper.state()
    hold = asyncio.ensure_future(gripper.hold(40.0))
    await until(lambda: emulator.events("write"))
    emulator.control("fault unplug")
    with pytest.raises(DeviceLost):
        await hold
    line = ModbusConnection("gripper", emulator.address, 9, 0.05)
    emulator.control("clear unplug")
    await line.connect()
    await line.read(0x07D0, 3, soon_s())
    emulator.control("fault silence 1")
    with pytest.raises(DeviceTimeout, match=r"no response within .*; the gripper may have executed the command"):
        await line.write(0x03E8, [0x0900, 255, 0xFFFF], soon_s())
    line.close()


async def test_a_gripper_that_only_times_out_is_lost(emulator: RobotiqEmulator) -> None:
    options = settings(emulator).model_copy(update={"timeout_ms": 100.0})
    gripper = RobotiqGripper(options, DriverContext("gripper"))
    await gripper.open()
    emulator.control("fault silence")
    began_s, errors = asyncio.get_running_loop().time(), []
    while not errors or isinstance(errors[-1], DeviceTimeout):
        with pytest.raises(DeviceError) as caught:
            await gripper.state()
        errors.append(caught.value)
    assert asyncio.get_running_loop().time() - began_s > 0.9
    assert isinstance(errors[-1], DeviceLost)
    assert "no response within" in str(errors[-1])
    with pytest.raises(DeviceTimeout):
        await gripper.open()
    emulator.control("clear silence")
    await gripper.open()
    assert (await gripper.state()).active
    await gripper.close()


async def test_a_gripper_is_not_lost_by_a_single_silent_call(emulator: RobotiqEmulator) -> None:
    gripper = RobotiqGripper(settings(emulator), DriverContext("gripper"))
    await gripper.open()
    for _ in range(2):
        gripper._silent_since_s = -1000.0  # as after a call that waited long
        emulator.control("fault silence")
        with pytest.raises(DeviceTimeout):
            await gripper.state()
        emulator.control("clear silence")
        assert (await gripper.state()).active
    gripper._silent_since_s = -1000.0
    emulator.control("fault silence")
    with pytest.raises(DeviceTimeout):
        await gripper.state()
    with pytest.raises(DeviceLost):
        await gripper.state()
    await gripper.close()


@each_model
async def test_jaws_that_stand_apart_without_an_object_are_at_rest(
    emulator: RobotiqEmulator, gripper: RobotiqGripper, monkeypatch: pytest.MonkeyPatch
) -> None:
    """gOBJ 3: at the requested position, or the object was lost. The fingers are blocked on the way."""
    monkeypatch.setattr(emulator.jaws, "drive", lambda *arguments: None)
    monkeypatch.setattr(emulator.registers, "_object", lambda now_s, view: 3)
    await gripper.hold(40.0)
    await until_it_rests(gripper)
    state = await gripper.state()
    assert (state.moving, state.holding, state.closed_on_nothing) == (False, False, False)
    assert state.width_mm > 0.9 * MODELS[emulator.settings.model].stroke_mm


@each_model
@pytest.mark.parametrize("lag_s", [0.0, 0.016, 0.1, 0.2])
@pytest.mark.parametrize("object_mm", [None, 41.2])
async def test_a_late_gobj_is_neither_a_grip_nor_closed_on_nothing(
    emulator: RobotiqEmulator, gripper: RobotiqGripper, lag_s: float, object_mm: float | None
) -> None:
    """With gOBJ 16 ms late, open jaws that had just begun to close were reported as closed on nothing."""
    emulator.registers.draw_lag_s = lambda: lag_s
    await gripper.release(85.0)
    await until_it_rests(gripper)
    put(emulator, object_mm)
    await gripper.hold(40.0)
    while (state := await gripper.state()).moving:
        assert (state.holding, state.closed_on_nothing) == (False, False)
    assert (state.holding, state.closed_on_nothing) == (object_mm is not None, object_mm is None)
    assert state.width_mm == pytest.approx(object_mm or 0.0, abs=0.4)


@each_model
@pytest.mark.parametrize("lag_s", [0.0, 0.016, 0.1, 0.2])
async def test_a_late_gobj_neither_ends_a_tightening_nor_prolongs_a_release(
    emulator: RobotiqEmulator, held: RobotiqGripper, lag_s: float
) -> None:
    emulator.registers.draw_lag_s = lambda: lag_s
    applied_n = await held.hold(150.0)
    while (state := await held.state()).moving:
        assert state.holding
    assert state.holding
    assert emulator.state()["force_n"] == pytest.approx(applied_n, abs=0.01)
    assert applied_n == pytest.approx(150.4, abs=0.5)
    await held.release(85.0)
    while (state := await held.state()).moving:
        assert not state.holding
    assert not state.holding
    assert state.width_mm == pytest.approx(MODELS[emulator.settings.model].stroke_mm, abs=0.4)


async def test_fingers_halted_before_gobj_shows_their_motion_stop(
    emulator: RobotiqEmulator, gripper: RobotiqGripper
) -> None:
    emulator.registers.draw_lag_s = lambda: 0.2
    put(emulator, 41.2)
    await gripper.hold(60.0)
    await gripper.halt()
    assert words_written(emulator)[-1].startswith("0100 00FF")
    assert not (await gripper.state()).moving
    assert not emulator.state()["moving"]


async def test_tightening_is_stop_then_go_and_never_opens(emulator: RobotiqEmulator, held: RobotiqGripper) -> None:
    await held.hold(80.0)
    # rACT stays set; rGTO 0, then 1; 20 N + 72 x 0.843 N
    assert words_written(emulator) == ["0100 00FF FF48", "0900 00FF FF48"]
    await until_it_rests(held)
    assert emulator.state()["force_n"] == pytest.approx(80.7, abs=0.1)
    assert emulator.events("released") == []


async def test_an_ignored_stop_is_reported(emulator: RobotiqEmulator, held: RobotiqGripper) -> None:
    emulator.control("fault ignore 1")
    with pytest.raises(DeviceTimeout, match="does not accept commands"):
        await held.hold(80.0)
    assert (await held.state()).force_n == pytest.approx(40.2, abs=0.1)
    assert await held.hold(80.0) == pytest.approx(80.7, abs=0.1)


async def test_an_ignored_go_is_reported(emulator: RobotiqEmulator, held: RobotiqGripper) -> None:
    occurs = iter([False, True])
    emulator._occurs = lambda fault: fault == "ignore" and next(occurs, False)  # type: ignore[method-assign]
    with pytest.raises(DeviceTimeout, match="does not accept commands"):
        await held.hold(80.0)
    assert (await held.state()).force_n == pytest.approx(40.2, abs=0.1)


async def test_an_interrupted_grip_is_completed_by_the_next_hold(
    emulator: RobotiqEmulator, held: RobotiqGripper
) -> None:
    emulator.control("fault deaf")
    with pytest.raises(DeviceTimeout):
        await held.hold(80.0)
    emulator.control("clear")
    emulator.registers.write(
        asyncio.get_running_loop().time(), 0x03E8, [0x0100]
    )  # the stop came through, the go did not
    await asyncio.sleep(0.01)
    assert await held.hold(30.0) == pytest.approx(40.2, abs=0.1), "the force that was there"
    assert words_written(emulator)[-1].startswith("0900 00FF")


async def test_a_halt_is_a_stop_with_the_goal_as_it_is(emulator: RobotiqEmulator) -> None:
    """What the fingers met before is not known: they close on it no faster than the first time."""
    put(emulator, 41.2)
    slow = settings(emulator).model_copy(update={"approach_speed": 0.25})
    gripper = RobotiqGripper(slow, DriverContext("gripper"))
    await gripper.open()
    await gripper.hold(60.0)
    await gripper.halt()
    assert words_written(emulator)[-1] == "0100 00FF 4000"
    assert (await gripper.state()).holding, "it may have met something"
    await gripper.halt()
    writes = len(words_written(emulator))
    await gripper.hold(40.0)
    assert words_written(emulator)[writes:][-1].split()[2].startswith("40")
    await gripper.close()


@pytest.mark.parametrize("requests", range(1, 6))
async def test_a_tightening_is_completed_though_its_caller_is_cancelled(
    emulator: RobotiqEmulator, held: RobotiqGripper, requests: int
) -> None:
    """requests: how many of its at least five Modbus requests have reached the gripper at the cancellation."""
    before = emulator.requests
    holding = asyncio.create_task(held.hold(80.0))
    for _ in range(1_000_000):
        if emulator.requests >= before + requests:
            break
        await asyncio.sleep(0.0)
    assert holding.cancel(), "it had ended already"
    with pytest.raises(asyncio.CancelledError):
        await holding
    await asyncio.sleep(0.1)
    await until_it_rests(held)
    assert emulator.state()["force_n"] == pytest.approx(80.7, abs=0.1)


@pytest.mark.parametrize(
    ("model", "width_mm", "object_mm", "force_n"), [("2F-140", 120.0, 100.0, 125.0), ("Hand-E", 42.0, 30.0, 185.0)]
)
async def test_each_model_has_its_own_force_and_width_range(
    tmp_path: Path, model: str, width_mm: float, object_mm: float, force_n: float
) -> None:
    emulator = quick(tmp_path, model=model, activated=True, object_width_mm=object_mm)
    await emulator.start()
    gripper = RobotiqGripper(settings(emulator), DriverContext("gripper"))
    await gripper.open()
    assert await gripper.move(width_mm, 30.0) == pytest.approx(width_mm, abs=0.4)
    await until_it_rests(gripper)
    assert emulator.state()["width_mm"] == pytest.approx(width_mm, abs=0.4)
    assert await gripper.hold(300.0) == force_n
    await until_it_rests(gripper)
    truth, state = emulator.state(), await gripper.state()
    assert (truth["force_n"], truth["width_mm"]) == (force_n, object_mm)
    assert state.holding
    assert state.width_mm == pytest.approx(object_mm, abs=0.7)
    await gripper.close()
    await emulator.stop()


async def test_power_lost_while_holding_never_opens(emulator: RobotiqEmulator, held: RobotiqGripper) -> None:
    emulator.control("fault power 1")
    with pytest.raises(DeviceTimeout):
        await held.hold(80.0)
    await asyncio.sleep(0.3)
    assert not (await held.state()).active
    with pytest.raises(CommandRefused, match="not activated"):
        await held.hold(80.0)
    assert emulator.state()["holds"]
    assert emulator.events("activating") == []
