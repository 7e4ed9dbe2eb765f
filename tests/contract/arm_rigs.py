"""The arms of the contract suite, each with a way to break it and, for guard mode, somebody else's program."""

from __future__ import annotations

import asyncio
from abc import ABC, abstractmethod
from typing import Literal

import pytest
from ur_scene import own_address

from slipguard.devices import Arm, DriverContext
from slipguard.sim.world import World
from slipguard_drivers.ur5.arm import Ur5Arm
from slipguard_drivers.ur5.fake import FakeArm
from slipguard_emulators.ur5.emulator import UrEmulator

Mode = Literal["lift", "guard"]
FAULTS = {"disconnect": "kill", "timeout": "freeze"}
"""What the emulator calls them, where it has another name."""


class Rig(ABC):
    """An arm and a way to break it. far_mm: how far it may be sent at most."""

    arm: Arm
    far_mm = 300.0

    async def start(self) -> None:
        """Let it be there."""
        return

    @abstractmethod
    def fail(self, kind: str) -> None:
        """disconnect, timeout, protective_stop or emergency_stop."""

    @abstractmethod
    def repair(self, kind: str) -> None: ...

    @abstractmethod
    def somebody_moves_it(self) -> None:
        """Another program lifts the arm by `far_mm`."""

    async def end(self) -> None:
        """Put it away."""
        return


class FakeRig(Rig):
    """The arm of an empty world."""

    def __init__(self, mode: Mode) -> None:
        self.world = World()
        self.arm = FakeArm(FakeArm.Settings(), DriverContext("arm", self.world, mode))

    def fail(self, kind: str) -> None:
        self.world.faults.fail("arm", kind)

    def repair(self, kind: str) -> None:
        self.world.faults.repair("arm", kind)

    def somebody_moves_it(self) -> None:
        self.world.command_lift(asyncio.get_running_loop().time(), self.far_mm, 100.0)


class WireRig(Rig):
    """The real driver with ur-rtde in its process, and an emulated controller on a loopback address of its own."""

    def __init__(self, mode: Mode, series: Literal["e", "cb3"]) -> None:
        self.controller = UrEmulator(UrEmulator.Settings(host=own_address(30), series=series))
        settings = Ur5Arm.Settings(host=self.controller.address, acceleration_mm_s2=1200.0)
        self.arm = Ur5Arm(settings, DriverContext("arm", mode=mode))

    async def start(self) -> None:
        await self.controller.start()

    def fail(self, kind: str) -> None:
        self.controller.control(f"fault {FAULTS.get(kind, kind)}")

    def repair(self, kind: str) -> None:
        self.controller.control(f"clear {FAULTS.get(kind, kind)}")

    def somebody_moves_it(self) -> None:
        self.controller.control("panel play")

    async def end(self) -> None:
        await self.controller.stop()


class RealRig(Rig):
    """A real robot, ready and in remote control, with room to move 60 mm up from where it stands."""

    far_mm = 60.0

    def __init__(self, mode: Mode, host: str) -> None:
        self.arm = Ur5Arm(Ur5Arm.Settings(host=host), DriverContext("arm", mode=mode))

    def fail(self, kind: str) -> None:
        pytest.skip(f"{kind} needs a hand at the robot")

    def repair(self, kind: str) -> None:
        pytest.skip(f"{kind} needs a hand at the robot")

    def somebody_moves_it(self) -> None:
        pytest.skip("another program needs a hand at the robot")


def rig_of(kind: str, mode: Mode, config: pytest.Config) -> Rig:
    """The rig of a parameter: fake, wire-e, wire-cb3 or real."""
    if kind == "fake":
        return FakeRig(mode)
    if kind == "real":
        return RealRig(mode, config.getoption("--arm"))
    return WireRig(mode, "cb3" if kind == "wire-cb3" else "e")


def kinds(config: pytest.Config, *, both_series: bool) -> list[str]:
    """The parameters there are; `real` only where an address is named."""
    return ["fake", "wire-cb3", *(["wire-e"] if both_series else []), *(["real"] if config.getoption("--arm") else [])]
