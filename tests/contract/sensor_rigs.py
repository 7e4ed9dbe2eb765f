"""Every sensor there is, with a hand on its cable: what the contract suite asks them all."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from usb_host import UsbCapture, listed

from slipguard.devices import DriverContext, TactileSensor
from slipguard.errors import DeviceLost
from slipguard.registry import load_driver
from slipguard.sim.world import World
from slipguard_drivers.digit.camera import DigitSensor
from slipguard_drivers.digit.discovery import DigitDevice
from slipguard_drivers.digit.fake import FakeSensor
from slipguard_drivers.digit.replay import ReplaySensor
from slipguard_drivers.socket_camera import SocketSensor
from slipguard_emulators.cell.frame_server import FrameServer
from slipguard_emulators.digit.emulator import DigitEmulator

STALL_MS = 500
FAULTS = {"stall": "stall", "frozen": "freeze", "corrupt": "corrupt", "disconnect": "unplug"}
"""What they are called on the emulated USB."""


class Rig:
    """A sensor and whoever may fail it: "stall", "frozen", "corrupt", "disconnect".

    slowest_s: from exposure to hand-over on a machine busy with other things.
    """

    slowest_s = 0.7
    sensor: TactileSensor

    async def begin(self) -> None:
        """Get ready what must run before the sensor is opened."""

    def fail(self, kind: str) -> None:
        pytest.skip(f"{kind} cannot be had of it")

    def repair(self, kind: str) -> None:
        pytest.skip(f"{kind} cannot be had of it")

    async def end(self) -> None:
        """Put away what `begin` got ready."""


class FakeRig(Rig):
    """A finger of an empty world."""

    def __init__(self, draw: str) -> None:
        self.world = World()
        self.sensor: TactileSensor = FakeSensor(
            FakeSensor.Settings.model_validate({"draw": draw, "stall_ms": STALL_MS}), DriverContext("left", self.world)
        )

    def fail(self, kind: str) -> None:
        self.world.faults.fail("left", kind)

    def repair(self, kind: str) -> None:
        self.world.faults.repair("left", kind)


class SocketRig(FakeRig):
    """The same finger behind a frame server, read by the driver of the socket."""

    def __init__(self, folder: Path) -> None:
        super().__init__("inline")
        self.server = FrameServer(folder / "left.sock", self.sensor, fps=60.0)
        self.server.plug()
        settings = SocketSensor.Settings(path=self.server.path, stall_ms=STALL_MS)
        self.sensor = SocketSensor(settings, DriverContext("left"))

    def fail(self, kind: str) -> None:
        super().fail(kind)
        if kind == "disconnect":
            self.server.unplug()

    def repair(self, kind: str) -> None:
        super().repair(kind)
        self.server.plug()

    async def end(self) -> None:
        await self.server.close()


class UsbRig(Rig):
    """The DIGIT driver on an emulated DIGIT over USB/IP; a USB host in user space stands in for the kernel."""

    def __init__(self, pixels: str) -> None:
        self.emulator = DigitEmulator(DigitEmulator.Settings.model_validate({"port": 0, "pixels": pixels}))
        settings = DigitSensor.Settings(serial="D20001", stall_ms=STALL_MS)
        self.sensor = DigitSensor(settings, DriverContext("left"), self._find, UsbCapture)

    def _find(self, serial: str, name: str) -> DigitDevice:
        if "1-1" not in listed(self.emulator.address):
            raise DeviceLost(f"{name}: {serial} is not plugged in")
        return DigitDevice(Path(self.emulator.address) / "1-1", serial, 212, "1-1", 480.0)

    async def begin(self) -> None:
        await self.emulator.start()

    def fail(self, kind: str) -> None:
        self.emulator.control(f"fault {FAULTS[kind]}")

    def repair(self, kind: str) -> None:
        self.emulator.control("clear")

    async def end(self) -> None:
        await self.emulator.stop()


class ReplayRig(Rig):
    """A folder of seven noise pictures, played for ever."""

    def __init__(self, folder: Path) -> None:
        noise_pictures(folder)
        self.sensor = ReplaySensor(ReplaySensor.Settings(path=folder), DriverContext("left"))


class RealRig(Rig):
    """A DIGIT on this machine's USB."""

    def __init__(self, serial: str) -> None:
        self.sensor = DigitSensor(DigitSensor.Settings(serial=serial, stall_ms=STALL_MS), DriverContext("left"))


class DriverRig(Rig):
    """A sensor whose driver another package has registered."""

    def __init__(self, name: str, settings: str) -> None:
        driver = load_driver("slipguard.tactile", name)
        self.sensor = driver(driver.Settings.model_validate_json(settings), DriverContext("left"))


def noise_pictures(folder: Path) -> None:
    """Seven of them."""
    rng = np.random.default_rng(5)
    for number in range(7):
        cv2.imwrite(str(folder / f"{number}.png"), rng.integers(0, 256, (320, 240, 3), np.uint8))


def kinds(config: pytest.Config, *, with_faults: bool) -> list[str]:
    """Those there are; `real` only where a serial number is named, `driver` only where one is."""
    all_fail = ["inline", "process", "socket", "usb", "usb-mjpg"]
    named = {"real": config.getoption("--digit"), "driver": config.getoption("--sensor-driver")}
    return all_fail if with_faults else [*all_fail, "replay", *(kind for kind, name in named.items() if name)]


def rig_of(kind: str, folder: Path, config: pytest.Config) -> Rig:
    """The rig of one kind."""
    if kind == "socket":
        return SocketRig(folder)
    if kind == "replay":
        return ReplayRig(folder)
    if kind == "driver":
        return DriverRig(config.getoption("--sensor-driver"), config.getoption("--sensor-settings"))
    if kind == "real":
        return RealRig(config.getoption("--digit"))
    return UsbRig("MJPG" if kind == "usb-mjpg" else "YUYV") if kind.startswith("usb") else FakeRig(kind)
