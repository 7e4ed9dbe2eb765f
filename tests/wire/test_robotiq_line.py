"""The real gripper driver on a bad line, and where it alone may move fingers."""

from __future__ import annotations

import asyncio
import os
from collections.abc import AsyncIterator
from pathlib import Path

import pytest

from slipguard.devices import DriverContext
from slipguard.errors import CommandRefused, DeviceLost, DeviceTimeout
from slipguard_drivers.robotiq import serial_port
from slipguard_drivers.robotiq.emulated_frames import crc16
from slipguard_drivers.robotiq.emulated_jaws import PlainJaws
from slipguard_drivers.robotiq.emulator import RobotiqEmulator
from slipguard_drivers.robotiq.gripper import RobotiqGripper
from slipguard_drivers.robotiq.line import RegisterLine

OBJECT_MM = 41.2


def quick(folder: Path, **options: object) -> RobotiqEmulator:
    """A 2F-85 with quick jaws on a wire that takes no time."""
    return RobotiqEmulator(
        RobotiqEmulator.Settings.model_validate(
            {"link": folder / "ttyGripper", "baud": 0, "response_ms": 0.0, "quick": 5.0, "late_ms": 150.0, **options}
        )
    )


def settings(emulator: RobotiqEmulator) -> RobotiqGripper.Settings:
    """The usual ones, but for a machine that is busy with other things."""
    return RobotiqGripper.Settings(port=emulator.address, approach_speed=1.0, timeout_ms=100.0)


@pytest.fixture
async def emulator(tmp_path: Path) -> AsyncIterator[RobotiqEmulator]:
    emulator = quick(tmp_path, activated=True)
    await emulator.start()
    yield emulator
    await emulator.stop()


@pytest.fixture
async def gripper(emulator: RobotiqEmulator) -> AsyncIterator[RobotiqGripper]:
    gripper = RobotiqGripper(settings(emulator), DriverContext("gripper"))
    await gripper.open()
    yield gripper
    await gripper.close()


@pytest.fixture
async def held(emulator: RobotiqEmulator, gripper: RobotiqGripper) -> RobotiqGripper:
    put(emulator, OBJECT_MM)
    await gripper.hold(40.0)
    await until_it_rests(gripper)
    assert (await gripper.state()).holding
    emulator.log.clear()
    return gripper


def put(emulator: RobotiqEmulator, object_mm: float | None) -> None:
    assert isinstance(emulator.jaws, PlainJaws)
    emulator.jaws.object_mm = object_mm


def soon_s() -> float:
    return asyncio.get_running_loop().time() + 1.0


def words_written(emulator: RobotiqEmulator) -> list[str]:
    return [" ".join(event["registers"]) for event in emulator.events("write")]  # type: ignore[arg-type]


async def until_it_rests(gripper: RobotiqGripper) -> None:
    for _ in range(300):
        if not (await gripper.state()).moving:
            return
        await asyncio.sleep(0.01)
    pytest.fail("it does not come to rest")


async def test_the_bytes_on_the_line_are_the_manuals(emulator: RobotiqEmulator) -> None:
    said: list[bytes] = []
    emulator._port._on_bytes = said.append
    line = RegisterLine("gripper", emulator.address, 9, 0.05, 0x07D0)
    await line.connect()
    for ask in (line.write(0x03E8, [0x0900, 0x00FF, 0xFFFF], soon_s()), line.read(0x07D0, 3, soon_s())):
        line._in_doubt = False
        with pytest.raises(DeviceTimeout):
            await ask
    assert b"".join(said) == bytes.fromhex("09 10 03E8 0003 06 0900 00FF FFFF 4229 09 04 07D0 0003 B1CE")
    line.close()


async def test_only_a_release_activates(tmp_path: Path) -> None:
    emulator = quick(tmp_path)
    await emulator.start()
    gripper = RobotiqGripper(settings(emulator), DriverContext("gripper"))
    await gripper.open()
    assert not (await gripper.state()).active
    for command in (gripper.hold(40.0), gripper.move(50.0, 40.0)):
        with pytest.raises(CommandRefused, match="not activated"):
            await command
    assert words_written(emulator) == []
    await gripper.release(85.0)
    assert emulator.registers.activations == 1
    assert (await gripper.state()).active
    await gripper.release(60.0)
    assert emulator.registers.activations == 1
    await gripper.close()
    await emulator.stop()


async def test_closing_the_connection_does_not_wait_for_an_activation(tmp_path: Path) -> None:
    emulator = quick(tmp_path, quick=1.0)
    await emulator.start()
    gripper = RobotiqGripper(settings(emulator), DriverContext("gripper"))
    await gripper.open()
    release = asyncio.ensure_future(gripper.release(85.0))
    await asyncio.sleep(0.2)
    await asyncio.wait_for(gripper.close(), 0.3)
    with pytest.raises(DeviceLost, match="release again"):
        await release
    await emulator.stop()


async def test_a_release_clears_a_fault(emulator: RobotiqEmulator, gripper: RobotiqGripper) -> None:
    emulator.control("gflt 0x0E")
    assert (await gripper.state()).fault == "overcurrent"
    await gripper.release(85.0)
    assert (await gripper.state()).fault is None


async def test_tightening_is_stop_then_go_and_never_lets_go(emulator: RobotiqEmulator, held: RobotiqGripper) -> None:
    await held.hold(80.0)
    # rACT stays set; rGTO 0, then 1; 20 N + 72 x 0.843 N
    assert words_written(emulator) == ["0100 00FF FF48", "0900 00FF FF48"]
    await until_it_rests(held)
    assert emulator.state()["force_n"] == pytest.approx(80.7, abs=0.1)
    assert emulator.events("let go") == []


async def test_a_stop_that_was_not_taken_is_no_tightening(emulator: RobotiqEmulator, held: RobotiqGripper) -> None:
    emulator.control("fault ignore 1")
    with pytest.raises(DeviceTimeout, match="does not take commands"):
        await held.hold(80.0)
    assert (await held.state()).force_n == pytest.approx(40.2, abs=0.1)
    assert await held.hold(80.0) == pytest.approx(80.7, abs=0.1)


async def test_a_go_that_was_not_taken_is_not_believed(emulator: RobotiqEmulator, held: RobotiqGripper) -> None:
    strikes = iter([False, True])
    emulator._strikes = lambda fault: fault == "ignore" and next(strikes, False)  # type: ignore[method-assign]
    with pytest.raises(DeviceTimeout, match="does not take commands"):
        await held.hold(80.0)
    assert (await held.state()).force_n == pytest.approx(40.2, abs=0.1)


async def test_while_the_force_rises_it_is_still_said_to_hold(emulator: RobotiqEmulator, held: RobotiqGripper) -> None:
    await held.hold(200.0)
    seen = [await held.state() for _ in range(10)]
    assert any(state.moving for state in seen)
    assert all(state.holding for state in seen)
    with pytest.raises(CommandRefused, match="held"):
        await held.move(80.0, 30.0)


async def test_a_grip_that_was_stopped_half_way_is_taken_up_again(
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


@pytest.mark.parametrize("after_s", [0.001, 0.006, 0.011, 0.016, 0.021])
async def test_a_tightening_whose_caller_gives_up_is_finished(
    emulator: RobotiqEmulator, held: RobotiqGripper, after_s: float
) -> None:
    with pytest.raises(TimeoutError):
        await asyncio.wait_for(held.hold(80.0), after_s)
    await asyncio.sleep(0.1)
    await until_it_rests(held)
    assert emulator.state()["force_n"] == pytest.approx(80.7, abs=0.1)


async def test_outwards_is_refused_while_the_fingers_close(emulator: RobotiqEmulator, gripper: RobotiqGripper) -> None:
    put(emulator, 30.0)
    await gripper.move(10.0, 60.0)
    with pytest.raises(CommandRefused, match="closing"):
        await gripper.move(70.0, 60.0)
    await gripper.move(5.0, 60.0)
    await until_it_rests(gripper)
    with pytest.raises(CommandRefused, match="held"):
        await gripper.move(70.0, 60.0)
    assert emulator.events("let go") == []


async def test_a_late_answer_is_never_taken_for_the_next(emulator: RobotiqEmulator, gripper: RobotiqGripper) -> None:
    emulator.control("fault late 1")
    with pytest.raises(DeviceTimeout, match="no answer within"):
        await gripper.state()
    put(emulator, OBJECT_MM)
    await gripper.hold(40.0)
    await until_it_rests(gripper)
    assert (await gripper.state()).holding


async def test_nor_is_one_that_is_later_than_the_silence_is_long(tmp_path: Path) -> None:
    emulator = quick(tmp_path, activated=True, late_ms=250.0)
    await emulator.start()
    gripper = RobotiqGripper(settings(emulator), DriverContext("gripper"))
    await gripper.open()
    emulator.control("fault late 1")
    with pytest.raises(DeviceTimeout):
        await gripper.state()
    put(emulator, OBJECT_MM)
    now_s = asyncio.get_running_loop().time()
    emulator.registers.write(now_s, 0x03E8, [0x0900, 255, 0xFFFF])  # somebody else closes it meanwhile
    for _ in range(4):
        try:
            state = await gripper.state()
        except DeviceTimeout:
            continue
        assert state.moving or state.holding, "an answer from before is taken for the present one"
    await gripper.close()
    await emulator.stop()


async def test_a_new_connection_never_gets_an_answer_to_the_old_ones_question(emulator: RobotiqEmulator) -> None:
    old, new = (RegisterLine("gripper", emulator.address, 9, 0.1, 0x07D0) for _ in range(2))
    await old.connect()
    await old.read(0x07D0, 3, soon_s())
    emulator.control("fault late 1")
    with pytest.raises(DeviceTimeout):
        await old.read(0x07D0, 3, soon_s())
    old.close()
    emulator.control("gflt 0x0E")
    await new.connect()
    assert (await new.read(0x07D0, 3, soon_s()))[1] >> 8 == 0x0E
    new.close()


async def test_after_a_time_out_the_line_is_silent_for_a_while(
    emulator: RobotiqEmulator, gripper: RobotiqGripper
) -> None:
    emulator.control("fault silence 1")
    with pytest.raises(DeviceTimeout):
        await gripper.state()
    loop = asyncio.get_running_loop()
    timed_out_at_s, asked = loop.time(), emulator.requests
    await gripper.state()
    assert emulator.requests == asked + 2, "one question to be sure of the line, and the one that was asked"
    assert loop.time() - timed_out_at_s >= 0.099


async def test_an_answer_that_comes_twice_casts_doubt_on_the_line(
    emulator: RobotiqEmulator, gripper: RobotiqGripper
) -> None:
    emulator.control("fault double 1")
    await gripper.state()
    await asyncio.sleep(0.01)
    asked = emulator.requests
    await gripper.state()
    assert emulator.requests == asked + 2


async def test_a_line_that_is_never_silent_is_told(emulator: RobotiqEmulator, gripper: RobotiqGripper) -> None:
    async def chatter() -> None:
        while True:
            emulator._port.send(b"\x55", emulator._port.plugs)
            await asyncio.sleep(0.01)

    talking = asyncio.create_task(chatter())
    await asyncio.sleep(0.03)
    with pytest.raises(DeviceTimeout, match="never silent"):
        async with asyncio.timeout(2.0):
            await gripper.state()
    talking.cancel()
    await asyncio.wait([talking])
    await gripper.state()


async def test_requests_keep_their_distance(emulator: RobotiqEmulator, gripper: RobotiqGripper) -> None:
    loop = asyncio.get_running_loop()
    before_s = loop.time()
    await asyncio.gather(*(gripper.state() for _ in range(11)))
    assert loop.time() - before_s >= 10 * 0.005 - 1e-6


async def test_a_torn_answer_is_put_together(emulator: RobotiqEmulator, gripper: RobotiqGripper) -> None:
    emulator.control("fault split")
    for _ in range(5):
        await gripper.state()


@pytest.mark.parametrize(
    "fault", ["bad_crc", "half", "garbage", "noise", "wrong_function", "wrong_length", "wrong_slave", "silence", "deaf"]
)
async def test_what_is_no_good_answer_to_a_read_is_a_time_out_and_the_next_is_fine(
    emulator: RobotiqEmulator, gripper: RobotiqGripper, fault: str
) -> None:
    emulator.control(f"fault {fault} 1")
    with pytest.raises(DeviceTimeout):
        await gripper.state()
    await gripper.state()


@pytest.mark.parametrize(
    "fault", ["bad_crc", "half", "noise", "wrong_function", "wrong_echo", "wrong_slave", "silence"]
)
async def test_what_is_no_good_answer_to_a_write_is_a_time_out_too(emulator: RobotiqEmulator, fault: str) -> None:
    line = RegisterLine("gripper", emulator.address, 9, 0.1, 0x07D0)
    await line.connect()
    await line.read(0x07D0, 3, soon_s())
    emulator.control(f"fault {fault} 1")
    with pytest.raises(DeviceTimeout):
        await line.write(0x03E8, [0x0900, 0, 0], soon_s())
    await line.write(0x03E8, [0x0900, 0, 0], soon_s())
    line.close()


async def test_no_answer_however_strange_trips_the_driver(emulator: RobotiqEmulator, gripper: RobotiqGripper) -> None:
    """Every function code with a good checksum: what pymodbus cannot make sense of it would raise inside the loop."""
    raised: list[object] = []
    asyncio.get_running_loop().set_exception_handler(lambda loop, context: raised.append(context))
    send = emulator._port.send
    for function in range(1, 256, 15):
        answer = bytes([9, function, 4, 0, 1, 2, 3])
        emulator._port.send = lambda data, plug, answer=answer: send(answer + crc16(answer), plug)  # type: ignore[method-assign]
        gripper._line._in_doubt = False
        with pytest.raises(DeviceTimeout):
            await gripper.state()
    assert raised == []


async def test_a_2f140_has_its_own_newtons_and_millimetres(tmp_path: Path) -> None:
    emulator = quick(tmp_path, model="2F-140", activated=True, object_width_mm=100.0)
    await emulator.start()
    gripper = RobotiqGripper(settings(emulator).model_copy(update={"model": "2F-140"}), DriverContext("gripper"))
    await gripper.open()
    assert await gripper.move(120.0, 30.0) == pytest.approx(120.0, abs=0.4)
    await until_it_rests(gripper)
    assert emulator.state()["width_mm"] == pytest.approx(120.0, abs=0.4)
    assert await gripper.hold(200.0) == 125.0
    await until_it_rests(gripper)
    truth, state = emulator.state(), await gripper.state()
    assert (truth["force_n"], truth["width_mm"]) == (125.0, 100.0)
    assert state.holding
    assert state.width_mm == pytest.approx(100.0, abs=0.7)
    await gripper.close()
    await emulator.stop()


async def test_a_gripper_that_takes_no_commands_is_told(emulator: RobotiqEmulator, gripper: RobotiqGripper) -> None:
    emulator.control("fault ignore")
    with pytest.raises(DeviceTimeout, match="another program"):
        await gripper.hold(40.0)


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


@pytest.mark.parametrize(
    ("make", "told"),
    [
        (lambda path: None, "no such device"),
        (lambda path: path.symlink_to("/dev/pts/no_such"), "unplugged"),
        (lambda path: path.write_text("no port"), "no serial port"),
    ],
)
async def test_a_port_that_is_none_is_told(tmp_path: Path, make: object, told: str) -> None:
    path = tmp_path / "ttyUSB9"
    make(path)  # type: ignore[operator]
    gripper = RobotiqGripper(RobotiqGripper.Settings(port=str(path)), DriverContext("gripper"))
    with pytest.raises(DeviceLost, match=told):
        await gripper.open()
    await gripper.close()


def test_a_port_that_may_not_be_used_names_the_group(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    assert "group" in serial_port.what_is_wrong("/dev/tty")


def test_an_adapter_that_keeps_answers_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "class" / "tty" / "ttyUSB0" / "device"
    folder.mkdir(parents=True)
    monkeypatch.setattr(serial_port, "SYS", tmp_path)
    assert serial_port.slow_adapter("/dev/ttyUSB0") is None
    (folder / "latency_timer").write_text("16\n")
    assert "16 ms" in (serial_port.slow_adapter("/dev/ttyUSB0") or "")
    (folder / "latency_timer").write_text("1\n")
    assert serial_port.slow_adapter("/dev/ttyUSB0") is None


async def test_a_silent_gripper_at_open_leaves_the_port_free(emulator: RobotiqEmulator) -> None:
    emulator.control("fault silence")
    gripper = RobotiqGripper(settings(emulator), DriverContext("gripper"))
    with pytest.raises(DeviceTimeout, match="power"):
        await gripper.open()
    emulator.control("clear")
    await gripper.open()
    await gripper.close()
