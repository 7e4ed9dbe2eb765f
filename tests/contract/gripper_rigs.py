"""The grippers of the contract suite, each with something to grip and a way to break it."""

from __future__ import annotations

import asyncio
from abc import ABC, abstractmethod
from pathlib import Path

from robotiq_emulator import RobotiqEmulator

from slipguard.devices import DriverContext, Gripper
from slipguard.sim.gripper_plant import GripperModel
from slipguard.sim.objects import SimObject
from slipguard.sim.scenario import Scenario
from slipguard.sim.world import World, WorldSettings
from slipguard_drivers.robotiq.fake import FakeGripper
from slipguard_drivers.robotiq.gripper import RobotiqGripper
from slipguard_drivers.robotiq.registers import MODEL_2F85, count_to_force


class Rig(ABC):
    """A gripper, what lies between its fingers, and a way to break it. Built with open fingers, not yet opened."""

    gripper: Gripper

    @abstractmethod
    def put_object(self) -> None: ...

    @abstractmethod
    def pressed_with_n(self) -> float:
        """The force the fingers press with by command, told by the double, not by the driver."""

    @abstractmethod
    def fail(self, kind: str) -> None: ...

    @abstractmethod
    def mend(self, kind: str) -> None: ...

    @abstractmethod
    def again(self) -> Gripper:
        """A new driver on the same gripper, as after a restart."""

    def end(self) -> None:
        """Put the double away."""
        return


class FakeRig(Rig):
    """A quick gripper in a world of its own."""

    def __init__(self, folder: Path) -> None:
        def lookup(name: str) -> SimObject:
            return SimObject(name, "test", lambda u, v: 0 * u, 0.05, 10.0, 1e-4, 0.9, 0.8, width_mm=70.0)

        self.model = GripperModel(transaction_s=0.004, dead_time_s=0.01, ramp_n_s=2000.0, speed_mm_s=300.0)
        self.world = World(WorldSettings(gripper=self.model), lookup=lookup)
        self.gripper = self.again()

    def put_object(self) -> None:
        self.world.place(Scenario("block", gripper=self.model), asyncio.get_running_loop().time())

    def pressed_with_n(self) -> float:
        return self.world.truth(asyncio.get_running_loop().time()).force_n

    def fail(self, kind: str) -> None:
        self.world.faults.fail("gripper", kind)

    def mend(self, kind: str) -> None:
        self.world.faults.mend("gripper", kind)

    def again(self) -> Gripper:
        return FakeGripper(FakeGripper.Settings(), DriverContext("gripper", self.world))


class WireRig(Rig):
    """The real driver, a pseudo terminal, and an emulated 2F-85."""

    def __init__(self, folder: Path) -> None:
        self.emulator = RobotiqEmulator(folder / "ttyGripper")
        loop = asyncio.get_running_loop()
        self.emulator.fingers.write([0x0100, 0, 0], loop.time() - 1.0)  # switched on and activated before our time
        self.emulator.fingers.activations = 0
        self.gripper = self.again()

    def put_object(self) -> None:
        self.emulator.fingers.object_at = 120.0

    def pressed_with_n(self) -> float:
        self.emulator.fingers.update(asyncio.get_running_loop().time())
        return count_to_force(self.emulator.fingers.grip, MODEL_2F85) if self.emulator.fingers.grip else 0.0

    def fail(self, kind: str) -> None:
        if kind == "disconnect":
            self.emulator.unplug()
        elif kind == "timeout":
            self.emulator.mute = True
        else:
            self.emulator.fingers.fault = 0x0E

    def mend(self, kind: str) -> None:
        if kind == "disconnect":
            self.emulator.plug()
        elif kind == "timeout":
            self.emulator.mute = False
        else:
            self.emulator.fingers.fault = 0

    def again(self) -> Gripper:
        settings = RobotiqGripper.Settings(port=str(self.emulator.path), approach_speed=1.0)
        return RobotiqGripper(settings, DriverContext("gripper"))

    def end(self) -> None:
        assert self.emulator.fingers.activations == 0, "activation moves the fingers: only a release may ask for it"
        self.emulator.unplug()
