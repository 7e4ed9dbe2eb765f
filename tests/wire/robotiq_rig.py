"""An emulated gripper on a pty, the real driver on it, and what a test does with both."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path

import pytest

from slipguard_drivers.robotiq.gripper import RobotiqGripper
from slipguard_emulators.robotiq.emulator import RobotiqEmulator
from slipguard_emulators.robotiq.jaws import SimpleJaws

OBJECT_MM = 41.2
each_model = pytest.mark.parametrize("emulator", ["2F-85", "Hand-E"], indirect=True)
"""Runs a test on each of these grippers."""


def quick(folder: Path, **options: object) -> RobotiqEmulator:
    """A 2F-85 (or another `model`) with quick jaws on a wire that takes no time."""
    return RobotiqEmulator(
        RobotiqEmulator.Settings.model_validate(
            {"link": folder / "ttyGripper", "baud": 0, "response_ms": 0.0, "quick": 5.0, "late_ms": 350.0, **options}
        )
    )


def settings(emulator: RobotiqEmulator) -> RobotiqGripper.Settings:
    """The usual ones, but for a machine that is busy with other things."""
    model = emulator.settings.model
    return RobotiqGripper.Settings(port=emulator.address, model=model, approach_speed=1.0, timeout_ms=300.0)


def put(emulator: RobotiqEmulator, object_mm: float | None) -> None:
    assert isinstance(emulator.jaws, SimpleJaws)
    emulator.jaws.object_mm = object_mm


def soon_s() -> float:
    return asyncio.get_running_loop().time() + 1.0


def words_written(emulator: RobotiqEmulator) -> list[str]:
    return [" ".join(event["registers"]) for event in emulator.events("write")]  # type: ignore[arg-type]


async def until(question: Callable[[], object]) -> None:
    """Wait until it becomes true."""
    for _ in range(2000):
        if question():
            return
        await asyncio.sleep(0.002)
    pytest.fail("it does not become true")


async def until_it_rests(gripper: RobotiqGripper) -> None:
    for _ in range(300):
        if not (await gripper.state()).moving:
            return
        await asyncio.sleep(0.01)
    pytest.fail("it does not come to rest")
