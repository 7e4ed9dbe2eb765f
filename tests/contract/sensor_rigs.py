"""The tactile sensors of the contract suite, each with a way to make it fail."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from rig import hardware_kinds, named_driver
from usb_host import UsbCapture, listed

from slipguard.devices import DriverContext, TactileSensor
from slipguard.errors import DeviceLost
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
"""The faults' names on the emulated USB."""


class SensorRig:
    """A sensor and its faults: "stall", "frozen", "corrupt", "disconnect".

    latency_max_s: from exposure to `next_frame` on a busy machine.
    """

    latency_max_s = 0.7
    sensor: TactileSensor

    async def start(self) -> None:
        """Start what must run before the sensor is opened."""

    def fail(self, fault: str) -> None:
        raise NotImplementedError

    def repair(self, fault: str) -> None:
        raise NotImplementedError

    async def stop(self) -> None:
        """Stop what `start` has started."""


class FakeSensorRig(SensorRig):
    """A finger of an empty simulated world."""

    def __init__(self, draw: str) -> None:
        self.world = World()
        self.sensor: TactileSensor = FakeSensor(
            FakeSensor.Settings.model_validate({"draw": draw, "stall_ms": STALL_MS}), DriverContext("left", self.world)
        )

    def fail(self, fault: str) -> None:
        self.world.faults.fail("left", fault)

    def repair(self, fault: str) -> None:
        self.world.faults.repair("left", fault)


class SocketSensorRig(FakeSensorRig):
    """The same finger behind a frame server, read by the driver `socket`."""

    def __init__(self, folder: Path) -> None:
        super().__init__("inline")
        self.server = FrameServer(folder / "left.sock", self.sensor, fps=60.0)
        self.server.plug()
        settings = SocketSensor.Settings(path=self.server.path, stall_ms=STALL_MS)
        self.sensor = SocketSensor(settings, DriverContext("left"))

    def fail(self, fault: str) -> None:
        super().fail(fault)
        if fault == "disconnect":
            self.server.unplug()

    def repair(self, fault: str) -> None:
        super().repair(fault)
        self.server.plug()

    async def stop(self) -> None:
        await self.server.close()


class UsbSensorRig(SensorRig):
    """The DIGIT driver on an emulated DIGIT over USB/IP; a USB host in user space replaces the kernel."""

    def __init__(self, pixels: str) -> None:
        self.emulator = DigitEmulator(DigitEmulator.Settings.model_validate({"port": 0, "pixels": pixels}))
        settings = DigitSensor.Settings(serial="D20001", stall_ms=STALL_MS)
        self.sensor = DigitSensor(settings, DriverContext("left"), self._find, UsbCapture)

    def _find(self, serial: str, name: str) -> DigitDevice:
        if "1-1" not in listed(self.emulator.address):
            raise DeviceLost(f"{name}: {serial} is not plugged in")
        return DigitDevice(Path(self.emulator.address) / "1-1", serial, 212, "1-1", 480.0)

    async def start(self) -> None:
        await self.emulator.start()

    def fail(self, fault: str) -> None:
        self.emulator.control(f"fault {FAULTS[fault]}")

    def repair(self, fault: str) -> None:
        self.emulator.control("clear")

    async def stop(self) -> None:
        await self.emulator.stop()


class ReplaySensorRig(SensorRig):
    """A folder of seven noise images, repeated."""

    def __init__(self, folder: Path) -> None:
        write_noise_images(folder)
        self.sensor = ReplaySensor(ReplaySensor.Settings(path=folder), DriverContext("left"))


class RealSensorRig(SensorRig):
    """A sensor of this machine: a DIGIT, or one whose driver another package has registered."""

    def __init__(self, sensor: TactileSensor) -> None:
        self.sensor = sensor


def write_noise_images(folder: Path) -> None:
    """Write seven noise images of the sensor's size."""
    rng = np.random.default_rng(5)
    for number in range(7):
        cv2.imwrite(str(folder / f"{number}.png"), rng.integers(0, 256, (320, 240, 3), np.uint8))


def abilities(config: pytest.Config) -> dict[str, set[str]]:
    """Return the kinds of rig, each with what it can do."""
    with_faults = {kind: {"faults"} for kind in ("inline", "process", "socket", "usb", "usb-mjpg")}
    return with_faults | {kind: set() for kind in ("replay", *hardware_kinds(config, "sensor", "--digit"))}


def make_rig(kind: str, folder: Path, config: pytest.Config) -> SensorRig:
    """Return a new rig of a kind."""
    if kind == "socket":
        return SocketSensorRig(folder)
    if kind == "replay":
        return ReplaySensorRig(folder)
    if kind == "driver":
        return RealSensorRig(named_driver(config, "sensor", DriverContext("left")))
    if kind == "real":
        settings = DigitSensor.Settings(serial=config.getoption("--digit"), stall_ms=STALL_MS)
        return RealSensorRig(DigitSensor(settings, DriverContext("left")))
    return UsbSensorRig("MJPG" if kind == "usb-mjpg" else "YUYV") if kind.startswith("usb") else FakeSensorRig(kind)
