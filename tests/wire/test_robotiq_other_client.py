"""The emulated gripper driven by another program's client, so that it is more than a mirror of our own driver."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from pathlib import Path

import pyrobotiqgripper
import pytest

from slipguard_emulators.robotiq.emulator import RobotiqEmulator
from slipguard_emulators.robotiq.jaws import SimpleJaws


@pytest.fixture
async def emulator(tmp_path: Path) -> AsyncIterator[RobotiqEmulator]:
    emulator = RobotiqEmulator(RobotiqEmulator.Settings(link=tmp_path / "ttyGripper", quick=5.0))
    emulator.registers.draw_lag_s = lambda: 0.0  # this client does not wait for gOBJ to follow a command
    await emulator.start()
    yield emulator
    await emulator.stop()


async def test_it_activates_moves_grips_and_reads(emulator: RobotiqEmulator) -> None:
    def drive() -> None:
        client = pyrobotiqgripper.RobotiqGripper(com_port=emulator.address)
        client.connect()
        try:
            assert not client.isActivated()
            client.activate()
            assert client.isActivated()
            client.start()
            client.move(128)
            assert abs(client.position() - 128) <= 1
            assert isinstance(emulator.jaws, SimpleJaws)
            emulator.jaws.object_mm = 20.0
            client.close(force=100)
            assert client.status()["gOBJ"] == 2
            client.open()
            assert abs(client.position() - emulator.registers.counts[0]) <= 1
            assert client.status()["gFLT"] == 0
        finally:
            client.disconnect()

    await asyncio.get_running_loop().run_in_executor(None, drive)
    expected = [event["event"] for event in emulator.log]
    assert expected.count("activating") == 1
    assert "gripped" in expected
    assert emulator.state()["width_mm"] == 85.0
