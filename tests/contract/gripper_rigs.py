"""The grippers of the contract suite, each with something to grip and a way to break it."""

from __future__ import annotations

import asyncio
from abc import ABC, abstractmethod
from pathlib import Path

import pytest
from timeouts import eventually

from slipguard.devices import DriverContext, Gripper
from slipguard.sim.gripper_plant import GripperDynamics
from slipguard.sim.scenario import Scenario
from slipguard.sim.sim_object import SimObject
from slipguard.sim.world import World, WorldSettings
from slipguard_drivers.robotiq.fake import FakeGripper
from slipguard_drivers.robotiq.gripper import RobotiqGripper
from slipguard_emulators.robotiq.emulator import RobotiqEmulator
from slipguard_emulators.robotiq.jaws import SimpleJaws


class Rig(ABC):
    """A gripper, what lies between its fingers, and a way to break it. Built with open fingers, not yet opened."""

    gripper: Gripper

    async def start(self) -> None:
        """Make it ready to be opened."""
        return

    @abstractmethod
    def put_object(self) -> None: ...

    @abstractmethod
    def pressed_with_n(self) -> float:
        """The force the fingers press with by command, told by the double, not by the driver."""

    @abstractmethod
    def fail(self, kind: str) -> None: ...

    @abstractmethod
    def repair(self, kind: str) -> None: ...

    @abstractmethod
    def again(self) -> Gripper:
        """A new driver on the same gripper, as after a restart."""

    async def end(self) -> None:
        """Put the double away."""
        return


class FakeRig(Rig):
    """A quick gripper in a world of its own."""

    def __init__(self, folder: Path) -> None:
        def lookup(name: str) -> SimObject:
            return SimObject(name, "test", lambda u, v: 0 * u, 0.05, 10.0, 1e-4, 0.9, 0.8, width_mm=70.0)

        self.model = GripperDynamics(transaction_s=0.004, dead_time_s=0.01, ramp_n_s=2000.0, speed_mm_s=300.0)
        self.world = World(WorldSettings(gripper=self.model), lookup=lookup)
        self.gripper = self.again()

    def put_object(self) -> None:
        self.world.place(Scenario("block", gripper=self.model), asyncio.get_running_loop().time())

    def pressed_with_n(self) -> float:
        return self.world.truth(asyncio.get_running_loop().time()).force_n

    def fail(self, kind: str) -> None:
        self.world.faults.fail("gripper", kind)

    def repair(self, kind: str) -> None:
        self.world.faults.repair("gripper", kind)

    def again(self) -> Gripper:
        return FakeGripper(FakeGripper.Settings(), DriverContext("gripper", self.world))


class WireRig(Rig):
    """The real driver, a pseudo terminal, and an emulated 2F-85 that was activated before our time."""

    def __init__(self, folder: Path) -> None:
        options = {"link": folder / "ttyGripper", "baud": 0, "response_ms": 0.0, "quick": 5.0, "activated": True}
        self.emulator = RobotiqEmulator(RobotiqEmulator.Settings.model_validate(options))
        self.gripper = self.again()

    async def start(self) -> None:
        await self.emulator.start()

    def put_object(self) -> None:
        assert isinstance(self.emulator.jaws, SimpleJaws)
        self.emulator.jaws.object_mm = 41.2

    def pressed_with_n(self) -> float:
        view = self.emulator.registers.tick(asyncio.get_running_loop().time())
        return view.force_n

    def fail(self, kind: str) -> None:
        self.emulator.control({"disconnect": "fault unplug", "timeout": "fault silence"}.get(kind, "gflt 0x0E"))

    def repair(self, kind: str) -> None:
        self.emulator.control({"disconnect": "clear unplug", "timeout": "clear silence"}.get(kind, "gflt 0"))

    def again(self) -> Gripper:
        settings = RobotiqGripper.Settings(
            port=str(self.emulator.settings.link),
            approach_speed=1.0,
            timeout_ms=200.0,  # a busy machine takes its time
        )
        return RobotiqGripper(settings, DriverContext("gripper"))

    async def end(self) -> None:
        assert self.emulator.registers.activations == 0, "activation moves the fingers: only a release may ask for it"
        assert self.emulator.events("rACT cleared") == []
        await self.emulator.stop()


class HardwareRig(Rig):
    """A real gripper. with_object: something to grip lies between its jaws throughout; without, nothing does."""

    def __init__(self, port: str, *, with_object: bool) -> None:
        self._port = port
        self._with_object = with_object
        self.gripper = self.again()

    async def start(self) -> None:
        """Open it; the first time its fingers move all the way."""
        await self.gripper.open()
        await self.gripper.release(85.0)
        await eventually(self.gripper.state, lambda state: not state.moving)
        await self.gripper.close()

    def put_object(self) -> None:
        if not self._with_object:
            pytest.skip("needs something to grip: --gripper-object")

    def pressed_with_n(self) -> float:
        pytest.skip("the force is known to a double only")

    def fail(self, kind: str) -> None:
        pytest.skip("needs a hand on the cable")

    def repair(self, kind: str) -> None:
        return

    def again(self) -> Gripper:
        return RobotiqGripper(RobotiqGripper.Settings(port=self._port), DriverContext("gripper"))
