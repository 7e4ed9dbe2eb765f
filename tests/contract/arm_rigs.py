"""The arms of the contract suite, each with a way to make it fail and, for guard mode, another program."""

from __future__ import annotations

import asyncio
from typing import Literal

import pytest
from rig import hardware_kinds, named_driver
from ur_scene import own_address

from slipguard.devices import Arm, DriverContext
from slipguard.sim.world import World
from slipguard_drivers.ur5.arm import Ur5Arm
from slipguard_drivers.ur5.fake import FakeArm
from slipguard_emulators.ur5.emulator import UrEmulator

GuardMode = Literal["lift", "guard"]
FAULTS = {"disconnect": "kill", "timeout": "freeze"}
"""The emulator's names where they differ."""


class ArmRig:
    """An arm and its faults. far_mm: the longest motion that a test may command."""

    arm: Arm
    far_mm = 300.0

    async def start(self) -> None:
        """Start what must run before the arm is opened."""

    def fail(self, fault: str) -> None:
        """Start a fault: disconnect, timeout, protective_stop or emergency_stop."""
        raise NotImplementedError

    def repair(self, fault: str) -> None:
        raise NotImplementedError

    def move_by_other_program(self) -> None:
        """Let another program lift the arm by `far_mm`."""
        raise NotImplementedError

    async def stop(self) -> None:
        """Stop what `start` has started."""


class FakeArmRig(ArmRig):
    """The arm of an empty simulated world."""

    def __init__(self, mode: GuardMode) -> None:
        self.world = World()
        self.arm = FakeArm(FakeArm.Settings(), DriverContext("arm", self.world, mode))

    def fail(self, fault: str) -> None:
        self.world.faults.fail("arm", fault)

    def repair(self, fault: str) -> None:
        self.world.faults.repair("arm", fault)

    def move_by_other_program(self) -> None:
        self.world.command_lift(asyncio.get_running_loop().time(), self.far_mm, 100.0)


class WireArmRig(ArmRig):
    """The real driver with ur-rtde in its process, and an emulated controller on a loopback address of its own."""

    def __init__(self, mode: GuardMode, series: Literal["e", "cb3"]) -> None:
        self.controller = UrEmulator(UrEmulator.Settings(host=own_address(30), series=series, ready=True))
        settings = Ur5Arm.Settings(host=self.controller.address, acceleration_mm_s2=1200.0)
        self.arm = Ur5Arm(settings, DriverContext("arm", mode=mode))

    async def start(self) -> None:
        await self.controller.start()

    def fail(self, fault: str) -> None:
        self.controller.control(f"fault {FAULTS.get(fault, fault)}")

    def repair(self, fault: str) -> None:
        self.controller.control(f"clear {FAULTS.get(fault, fault)}")

    def move_by_other_program(self) -> None:
        self.controller.control("panel play")

    async def stop(self) -> None:
        await self.controller.stop()


class HardwareArmRig(ArmRig):
    """An arm outside this process, ready to move, with 60 mm of free space above its tool."""

    far_mm = 60.0

    def __init__(self, arm: Arm) -> None:
        self.arm = arm


def make_rig(kind: str, mode: GuardMode, config: pytest.Config) -> ArmRig:
    """Return a new rig of a kind."""
    context = DriverContext("arm", mode=mode)
    if kind == "fake":
        return FakeArmRig(mode)
    if kind == "real":
        return HardwareArmRig(Ur5Arm(Ur5Arm.Settings(host=config.getoption("--arm")), context))
    if kind == "driver":
        return HardwareArmRig(named_driver(config, "arm", context))
    return WireArmRig(mode, "cb3" if kind == "wire-cb3" else "e")


def abilities(config: pytest.Config, *, both_series: bool) -> dict[str, set[str]]:
    """Return the kinds of rig, each with what it can do."""
    doubles = ["fake", "wire-cb3", *(["wire-e"] if both_series else [])]
    everything = {"faults", "other program"}
    return dict.fromkeys(doubles, everything) | {kind: set() for kind in hardware_kinds(config, "arm", "--arm")}
