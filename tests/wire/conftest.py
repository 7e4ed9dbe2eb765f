"""Fixtures: an emulated gripper, the driver that has it open, and one that holds something."""

from __future__ import annotations

from collections.abc import AsyncIterator
from pathlib import Path

import pytest
from robotiq_rig import OBJECT_MM, put, quick, settings, until_it_rests

from slipguard.devices import DriverContext
from slipguard_drivers.robotiq.gripper import RobotiqGripper
from slipguard_emulators.robotiq.emulator import RobotiqEmulator


@pytest.fixture
async def emulator(request: pytest.FixtureRequest, tmp_path: Path) -> AsyncIterator[RobotiqEmulator]:
    """A 2F-85, or the model that is the parameter."""
    emulator = quick(tmp_path, activated=True, model=getattr(request, "param", "2F-85"))
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
