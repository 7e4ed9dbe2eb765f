"""The real gripper driver on a bad line: late, torn, foreign and missing responses, and invalid ports."""

from __future__ import annotations

import asyncio
import math
import os
from pathlib import Path

import pytest
from robotiq_rig import OBJECT_MM, put, quick, settings, soon_s, until_it_rests

from slipguard.devices import DriverContext
from slipguard.errors import DeviceLost, DeviceTimeout
from slipguard_drivers.robotiq import serial_port
from slipguard_drivers.robotiq.gripper import RobotiqGripper
from slipguard_drivers.robotiq.modbus import ModbusConnection
from slipguard_emulators.robotiq.emulator import RobotiqEmulator
from slipguard_emulators.robotiq.modbus_frames import crc16


async def test_a_late_answer_is_never_taken_for_the_next(emulator: RobotiqEmulator, gripper: RobotiqGripper) -> None:
    emulator.control("fault late 1")
    with pytest.raises(DeviceTimeout, match="no response within"):
        await gripper.state()
    put(emulator, OBJECT_MM)
    await gripper.hold(40.0)
    await until_it_rests(gripper)
    assert (await gripper.state()).holding


async def test_a_response_later_than_the_silence_is_never_taken_for_the_next(tmp_path: Path) -> None:
    emulator = quick(tmp_path, activated=True, late_ms=750.0)
    await emulator.start()
    gripper = RobotiqGripper(settings(emulator), DriverContext("gripper"))
    await gripper.open()
    emulator.control("fault late 1")
    with pytest.raises(DeviceTimeout):
        await gripper.state()
    put(emulator, OBJECT_MM)
    now_s = asyncio.get_running_loop().time()
    emulator.registers.write(now_s, 0x03E8, [0x0900, 255, 0xFFFF])  # another program closes it meanwhile
    for _ in range(4):
        try:
            state = await gripper.state()
        except DeviceTimeout:
            continue
        assert state.moving or state.holding, "an answer from before is taken for the present one"
    await gripper.close()
    await emulator.stop()


async def test_a_new_connection_ignores_responses_to_old_requests(emulator: RobotiqEmulator) -> None:
    old, new = (ModbusConnection("gripper", emulator.address, 9, 0.3) for _ in range(2))
    await old.connect()
    await old.read(0x07D0, 3, soon_s())
    emulator.control("fault late 1")
    with pytest.raises(DeviceTimeout):
        await old.read(0x07D0, 3, soon_s())
    old.close()
    await old.closed()
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


async def test_a_repeated_response_puts_the_line_out_of_sync(
    emulator: RobotiqEmulator, gripper: RobotiqGripper
) -> None:
    emulator.control("fault double 1")
    await gripper.state()
    await asyncio.sleep(0.01)
    asked = emulator.requests
    await gripper.state()
    assert emulator.requests == asked + 2


async def test_a_line_that_is_never_silent_is_reported(emulator: RobotiqEmulator, gripper: RobotiqGripper) -> None:
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


async def test_a_response_in_two_parts_is_accepted(emulator: RobotiqEmulator, gripper: RobotiqGripper) -> None:
    emulator.control("fault split")
    for _ in range(5):
        await gripper.state()


@pytest.mark.parametrize(
    "fault", ["bad_crc", "half", "garbage", "noise", "wrong_function", "wrong_length", "wrong_slave", "silence", "deaf"]
)
async def test_an_invalid_response_to_a_read_is_a_time_out_and_the_next_is_good(
    emulator: RobotiqEmulator, gripper: RobotiqGripper, fault: str
) -> None:
    emulator.control(f"fault {fault} 1")
    with pytest.raises(DeviceTimeout):
        await gripper.state()
    await gripper.state()


@pytest.mark.parametrize(
    "fault", ["bad_crc", "half", "noise", "wrong_function", "wrong_echo", "wrong_slave", "silence"]
)
async def test_an_invalid_response_to_a_write_is_a_time_out(emulator: RobotiqEmulator, fault: str) -> None:
    line = ModbusConnection("gripper", emulator.address, 9, 0.3)
    await line.connect()
    await line.read(0x07D0, 3, soon_s())
    emulator.control(f"fault {fault} 1")
    with pytest.raises(DeviceTimeout):
        await line.write(0x03E8, [0x0900, 0, 0], soon_s())
    await line.write(0x03E8, [0x0900, 0, 0], soon_s())
    line.close()


async def test_no_response_crashes_the_driver(emulator: RobotiqEmulator, gripper: RobotiqGripper) -> None:
    """Every function code with a good checksum: none raises inside the loop."""
    raised: list[object] = []
    asyncio.get_running_loop().set_exception_handler(lambda loop, context: raised.append(context))
    send = emulator._port.send
    for function in range(1, 256, 15):
        answer = bytes([9, function, 4, 0, 1, 2, 3])
        emulator._port.send = lambda data, plug, answer=answer: send(answer + crc16(answer), plug)  # type: ignore[method-assign]
        gripper._transport._out_of_sync, gripper._silent_since_s = False, math.inf
        with pytest.raises(DeviceTimeout):
            await gripper.state()
    assert raised == []


@pytest.mark.parametrize(
    ("make", "expected"),
    [
        (lambda path: None, "no such device"),
        (lambda path: path.symlink_to("/dev/pts/no_such"), "unplugged"),
        (lambda path: path.write_text("no port"), "not a serial port"),
    ],
)
async def test_a_path_that_is_not_a_serial_port_is_reported(tmp_path: Path, make: object, expected: str) -> None:
    path = tmp_path / "ttyUSB9"
    make(path)  # type: ignore[operator]
    gripper = RobotiqGripper(RobotiqGripper.Settings(port=str(path)), DriverContext("gripper"))
    with pytest.raises(DeviceLost, match=expected):
        await gripper.open()
    await gripper.close()


def test_a_port_that_may_not_be_used_names_the_group(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    assert "group" in serial_port.why_not_usable("/dev/tty")


def test_a_slow_adapter_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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
