"""The grippers of the contract suite, each with an object to grip and a way to make it fail."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping
from pathlib import Path

import pytest
from rig import hardware_kinds, named_driver
from timeouts import eventually

from slipguard.devices import DriverContext, Gripper
from slipguard.sim.gripper_plant import GripperDynamics
from slipguard.sim.scenario import Scenario
from slipguard.sim.sim_object import SimObject
from slipguard.sim.world import World, WorldSettings
from slipguard_drivers.robotiq.fake import FakeGripper
from slipguard_drivers.robotiq.gripper import RobotiqGripper
from slipguard_drivers.robotiq.registers import MODELS
from slipguard_emulators.robotiq.emulator import RobotiqEmulator
from slipguard_emulators.robotiq.jaws import SimpleJaws

WIRE: dict[str, dict[str, object]] = {
    "wire": {"model": "2F-85"},
    "hand-e": {"model": "Hand-E"},
    "forwarder": {"wiring": "forwarder", "tcp_port": 0},
    "urcap": {"wiring": "urcap", "tcp_port": 0},
}
"""The emulated grippers behind the real driver, by the kind of rig."""


class GripperRig:
    """A gripper, the object between its fingers, and its faults. Built with open fingers, not yet connected.

    open_mm: the width of the open fingers. status_age_s: a status may be this old, because a transport keeps a copy.
    """

    gripper: Gripper
    open_mm = 85.0
    status_age_s = 0.0

    @property
    def step_n(self) -> float:
        """Resolution of the force: one of 255 steps."""
        low_n, high_n = self.gripper.force_limits_n
        return (high_n - low_n) / 253

    @property
    def step_mm(self) -> float:
        """Resolution of the width: one of 227 steps."""
        return self.open_mm / 223

    def force(self, share: float) -> float:
        """Return a force within the limits. share: 0 is the lowest, 1 the highest."""
        low_n, high_n = self.gripper.force_limits_n
        return round(low_n + share * (high_n - low_n), 1)

    async def start(self) -> None:
        """Make it ready to be opened."""

    def put_object(self) -> None:
        raise NotImplementedError

    def pressed_n(self) -> float | None:
        """Return the force on the object as the double knows it, independent of the driver; None for hardware."""
        raise NotImplementedError

    def fail(self, fault: str) -> None:
        raise NotImplementedError

    def repair(self, fault: str) -> None:
        raise NotImplementedError

    def lose_power(self) -> None:
        """Take its power away for a moment: it is not active any more."""
        raise NotImplementedError

    def new_driver(self) -> Gripper:
        """Return a new driver for the same gripper, as after a restart."""
        raise NotImplementedError

    async def stop(self) -> None:
        """Stop what `start` has started."""


class FakeGripperRig(GripperRig):
    """A fast gripper in a simulated world of its own."""

    def __init__(self) -> None:
        def lookup(name: str) -> SimObject:
            return SimObject(name, "test", lambda u, v: 0 * u, 0.05, 10.0, 1e-4, 0.9, 0.8, width_mm=70.0)

        self.model = GripperDynamics(transaction_s=0.004, dead_time_s=0.01, ramp_n_s=2000.0, speed_mm_s=300.0)
        self.world = World(WorldSettings(gripper=self.model), lookup=lookup)
        self.gripper = self.new_driver()

    def put_object(self) -> None:
        self.world.place(Scenario("block", gripper=self.model), asyncio.get_running_loop().time())

    def pressed_n(self) -> float:
        return self.world.truth(asyncio.get_running_loop().time()).force_n

    def fail(self, fault: str) -> None:
        self.world.faults.fail("gripper", fault)

    def repair(self, fault: str) -> None:
        self.world.faults.repair("gripper", fault)

    def lose_power(self) -> None:
        self.world.gripper_activated = False

    def new_driver(self) -> Gripper:
        return FakeGripper(FakeGripper.Settings(), DriverContext("gripper", self.world))


class WireGripperRig(GripperRig):
    """The real driver on one of its transports, and an emulated gripper that is activated already."""

    def __init__(self, folder: Path, options: Mapping[str, object]) -> None:
        quick = {"link": folder / "ttyGripper", "baud": 0, "response_ms": 0.0, "quick": 5.0, "activated": True}
        self.emulator = RobotiqEmulator(RobotiqEmulator.Settings.model_validate({**quick, **options}))
        self.open_mm = MODELS[self.emulator.settings.model].stroke_mm
        if self.emulator.settings.wiring == "urcap":
            self.status_age_s = 2e-3 * self.emulator.settings.refresh_ms  # one refresh, and its jitter

    async def start(self) -> None:
        await self.emulator.start()
        self.gripper = self.new_driver()

    def put_object(self) -> None:
        assert isinstance(self.emulator.jaws, SimpleJaws)
        self.emulator.jaws.object_mm = 41.2

    def pressed_n(self) -> float:
        view = self.emulator.registers.tick(asyncio.get_running_loop().time())
        return view.force_n

    def fail(self, fault: str) -> None:
        self.emulator.control({"disconnect": "fault unplug", "timeout": "fault silence"}.get(fault, "gflt 0x0E"))

    def repair(self, fault: str) -> None:
        self.emulator.control({"disconnect": "clear unplug", "timeout": "clear silence"}.get(fault, "gflt 0"))

    def lose_power(self) -> None:
        self.emulator.registers.lose_power(asyncio.get_running_loop().time())

    def new_driver(self) -> Gripper:
        busy_ms = 200.0  # a busy machine is slow
        keys = {"model": self.emulator.settings.model, "approach_speed": 1.0, "timeout_ms": busy_ms}
        settings = RobotiqGripper.Settings.model_validate(keys | self.emulator.driver_settings)
        return RobotiqGripper(settings, DriverContext("gripper"))

    async def stop(self) -> None:
        assert self.emulator.registers.activations == 0, "activation moves the fingers: only `activate` may start it"
        assert self.emulator.events("rACT cleared") == []
        await self.emulator.stop()


class HardwareGripperRig(GripperRig):
    """A gripper outside this process, with an object between its fingers all the time or never."""

    def __init__(self, build: Callable[[], Gripper]) -> None:
        self._build = build
        self.gripper = build()

    async def start(self) -> None:
        """Open it. Some grippers must be activated first: their fingers move all the way."""
        await self.gripper.open()
        if not (await self.gripper.state()).active:
            await self.gripper.activate()
        await self.gripper.release(1000.0)
        self.open_mm = (await eventually(self.gripper.state, lambda state: not state.moving)).width_mm
        await self.gripper.close()

    def put_object(self) -> None:
        return

    def pressed_n(self) -> None:
        return None

    def new_driver(self) -> Gripper:
        return self._build()


def abilities(config: pytest.Config) -> dict[str, set[str]]:
    """Return the kinds of rig, each with what it can do."""
    everything = {"object", "no object", "faults", "pressed force"}
    between = {"object"} if config.getoption("--gripper-object") else {"no object"}
    return dict.fromkeys(("fake", *WIRE), everything) | dict.fromkeys(
        hardware_kinds(config, "gripper", "--gripper"), between
    )


def make_rig(kind: str, folder: Path, config: pytest.Config) -> GripperRig:
    """Return a new rig of a kind."""
    context = DriverContext("gripper")
    if kind == "real":
        settings = RobotiqGripper.Settings(port=config.getoption("--gripper"))
        return HardwareGripperRig(lambda: RobotiqGripper(settings, context))
    if kind == "driver":
        return HardwareGripperRig(lambda: named_driver(config, "gripper", context))
    return FakeGripperRig() if kind == "fake" else WireGripperRig(folder, WIRE[kind])
