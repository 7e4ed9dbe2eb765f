"""No other program uses the gripper's line: two masters could open a grip."""

from __future__ import annotations

import asyncio
import os
import subprocess
import sys
import threading
from collections.abc import AsyncIterator
from pathlib import Path

import pytest

from slipguard.devices import DriverContext
from slipguard.errors import DeviceLost
from slipguard_drivers.robotiq import serial_port
from slipguard_drivers.robotiq.gripper import RobotiqGripper
from slipguard_drivers.robotiq.modbus import ModbusConnection
from slipguard_emulators.robotiq.emulator import RobotiqEmulator


@pytest.fixture
async def emulator(tmp_path: Path) -> AsyncIterator[RobotiqEmulator]:
    options = {"link": tmp_path / "ttyGripper", "baud": 0, "response_ms": 0.0, "activated": True}
    emulator = RobotiqEmulator(RobotiqEmulator.Settings.model_validate(options))
    await emulator.start()
    yield emulator
    await emulator.stop()


def driver(emulator: RobotiqEmulator) -> RobotiqGripper:
    return RobotiqGripper(RobotiqGripper.Settings(port=emulator.address, timeout_ms=100.0), DriverContext("gripper"))


def have_we(port: str) -> bool:
    """Whether this process has the port open."""
    files = [Path("/proc/self/fd") / name for name in os.listdir("/proc/self/fd")]
    return os.path.realpath(port) in [os.path.realpath(one) for one in files]


async def another_master(emulator: RobotiqEmulator, *, exclusive: bool) -> asyncio.subprocess.Process:
    """Another program that has the port open, with a lock on it or without."""
    script = (
        "import serial, sys; port = serial.Serial(sys.argv[1], exclusive=%s); "
        "print('open', flush=True); sys.stdin.read()"
    )
    other = await asyncio.create_subprocess_exec(
        *(sys.executable, "-c", script % exclusive, emulator.address), stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    assert other.stdout is not None
    assert await other.stdout.readline() == b"open\n"
    return other


async def test_a_port_already_open_without_lock_is_not_used(emulator: RobotiqEmulator) -> None:
    other = await another_master(emulator, exclusive=False)
    gripper = driver(emulator)
    for _ in range(2):
        with pytest.raises(DeviceLost, match=rf"\(process {other.pid}\) has it open"):
            await gripper.open()
        with pytest.raises(DeviceLost):
            await gripper.hold(40.0)
    async with asyncio.timeout(10.0):  # our own end is closed again, in a thread
        while have_we(emulator.address):  # noqa: ASYNC110 - a list of files
            await asyncio.sleep(0.01)
    assert emulator.requests == 0
    other.terminate()
    await other.wait()
    await gripper.open()
    assert (await gripper.state()).active
    await gripper.close()


async def test_a_cancelled_search_for_other_programs_closes_the_port(
    emulator: RobotiqEmulator, monkeypatch: pytest.MonkeyPatch
) -> None:
    looking, go_on = threading.Event(), threading.Event()

    def slow(port: str) -> set[int]:
        looking.set()
        go_on.wait(10.0)
        return set()

    monkeypatch.setattr(serial_port, "other_holders", slow)
    line = ModbusConnection("gripper", emulator.address, 9, 0.05)
    opening = asyncio.create_task(line.connect())
    await asyncio.to_thread(looking.wait, 10.0)
    assert not line.connected, "nothing is asked before the look has ended"
    opening.cancel()
    with pytest.raises(asyncio.CancelledError):
        await opening
    go_on.set()
    assert not line.connected
    await line.connect()
    assert line.connected
    line.close()


async def test_the_port_is_exclusive_and_its_holder_is_reported(emulator: RobotiqEmulator) -> None:
    other = await another_master(emulator, exclusive=True)
    gripper = driver(emulator)
    with pytest.raises(DeviceLost, match=rf"\(process {other.pid}\) has it open"):
        await gripper.open()
    assert other.pid in serial_port.other_holders(emulator.address)
    other.terminate()
    await other.wait()
    await gripper.open()
    second = driver(emulator)
    with pytest.raises(DeviceLost, match="another program"):
        await second.open()
    await second.close()
    await gripper.state()
    await gripper.close()
