"""DIGITs as USB devices over the network: a real kernel plugs them in as cameras, with faults on demand."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, field_validator

from slipguard.emulator import Report
from slipguard.errors import InputError
from slipguard_emulators.base import ControlledEmulator, EmulatorCommand
from slipguard_emulators.digit.frames import drawn, on_the_wire, read
from slipguard_emulators.digit.usb_descriptors import PRODUCT_ID, VENDOR_ID
from slipguard_emulators.digit.usbip import BulkInEndpoint, UsbDevice, UsbIpServer
from slipguard_emulators.digit.uvc_device import UvcDevice

Image = NDArray[np.uint8]

FAULTS = {
    "stall": "no picture is sent",
    "freeze": "the same picture is sent again",
    "corrupt": "a picture is sent with the error flag of its USB payload",
    "short": "half of a picture is sent as if it were all",
    "unplug": "the cable is pulled; clear it to plug the sensor in again (it must be attached anew)",
}
SHARE_SENT = 0.5


class DigitEmulator(ControlledEmulator):
    """Emulate DIGIT cameras as USB devices, for `usbip attach -r HOST -b 1-1` (the second sensor is 1-2).

    Faults strike all sensors, or one where its serial stands before the name: `fault D20002.unplug`.

    Example: `slipguard emulate digit --serial D20001 --fault corrupt:0.01`
    """

    class Settings(BaseModel):
        """The command's options."""

        model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

        serial: Annotated[
            list[str],
            Field(min_length=1, max_length=8, description="Serial number of a sensor; repeat it for more sensors."),
        ] = ["D20001"]
        host: Annotated[str, Field(description="Address to listen at.")] = "127.0.0.1"
        port: Annotated[int, Field(ge=0, le=65535, description="TCP port; 0: any free one.")] = 3240
        pixels: Annotated[Literal["YUYV", "MJPG", "both"], Field(description="Pixel formats on offer.")] = "YUYV"
        firmware: Annotated[int, Field(ge=0, le=9999, description="212 is 2.12; below 200 its LEDs are one.")] = 212
        pictures: Annotated[
            Path | None,
            Field(
                description="Folder of pictures, 240 wide x 320 high, or of one such folder by serial; default: drawn."
            ),
        ] = None
        object: Annotated[str, Field(description="What presses into the gel in the drawn pictures.")] = "bar"
        seed: Annotated[int, Field(ge=0, description="Seed of all that is random.")] = 0

        @field_validator("serial")
        @classmethod
        def _distinct(cls, serials: list[str]) -> list[str]:
            odd = [serial for serial in serials if not (serial.isascii() and serial.isalnum())]
            if odd:
                raise ValueError(f"{odd[0]!r}: letters and digits are allowed")
            if len(set(serials)) < len(serials):
                raise ValueError("every sensor needs a serial number of its own")
            return serials

    def __init__(self, settings: Settings, report: Report | None = None) -> None:
        several = len(settings.serial) > 1
        of_one = {f"{serial}.{name}": text for serial in settings.serial for name, text in FAULTS.items()}
        super().__init__(FAULTS | (of_one if several else {}), settings.seed, report)
        self.settings = settings
        self.cameras = {
            f"1-{number}": EmulatedCamera(self, serial, number) for number, serial in enumerate(settings.serial, 1)
        }
        self._usbip = UsbIpServer(self.cameras)
        self._server: asyncio.Server | None = None
        self._address = ""

    @property
    def address(self) -> str:
        """Host and port."""
        return self._address

    @property
    def port(self) -> int:
        """Where it listens; known after `start`."""
        return int(self._address.rpartition(":")[2])

    async def start(self) -> None:
        """Draw or read the pictures and listen. Raises InputError where that is not possible."""
        settings = self.settings
        for camera in self.cameras.values():
            await asyncio.to_thread(getattr, camera, "pictures")
        try:
            self._server = await asyncio.start_server(self._usbip.serve, settings.host, settings.port)
        except OSError as error:
            where = f"{settings.host}:{settings.port}"
            raise InputError(
                f"{where} cannot be listened at ({error.strerror or error}); choose another port"
            ) from None
        host, port = self._server.sockets[0].getsockname()[:2]
        self._address = f"{host}:{port}"

    async def stop(self) -> None:
        """Vanish."""
        if self._server is not None:
            self._server.close()
            await self._usbip.stop()
            await self._server.wait_closed()
            self._server = None

    def state(self) -> dict[str, object]:
        """The truth now."""
        told: dict[str, object] = {camera.unit.serial: camera.summary for camera in self.cameras.values()}
        return told | {"faults": self.faults.active or "none"}

    def words(self) -> dict[str, EmulatorCommand]:
        """None of its own."""
        return {}

    def fault_changed(self) -> None:
        """Pull or plug cables at once."""
        for camera in self.cameras.values():
            camera.heed_cable()


class EmulatedCamera(UsbDevice):
    """One sensor of the emulator: paces its pictures and lets the faults strike them."""

    def __init__(self, emulator: DigitEmulator, serial: str, number: int) -> None:
        settings = emulator.settings
        formats = ("YUYV", "MJPG") if settings.pixels == "both" else (settings.pixels,)
        self.unit = UvcDevice(serial, formats, settings.firmware, emulator.note)
        self.sent = 0
        """Pictures that went out."""
        self._emulator = emulator
        self._number = number
        self._plugged = True
        self._connection: asyncio.StreamWriter | None = None
        self._packed: dict[tuple[str, int, int], bytes] = {}
        self._last: bytes | None = None
        self._exposed = 0

    @property
    def identity(self) -> tuple[int, int, int]:
        """As a DIGIT."""
        return VENDOR_ID, PRODUCT_ID, int(str(self.unit.firmware), 16)

    @property
    def plugged(self) -> bool:
        """Whether its cable is in."""
        return self._plugged

    @property
    def summary(self) -> str:
        """In a few words."""
        where = "attached" if self._connection else "not attached" if self._plugged else "unplugged"
        return f"{where}, {self.sent} pictures sent, LEDs {self.unit.zoom:#05x}"

    @cached_property
    def pictures(self) -> Sequence[Image]:
        """What it sends in turn, portrait BGR."""
        settings = self._emulator.settings
        if settings.pictures is None:
            return drawn(settings.seed + self._number, settings.object)
        own = settings.pictures / self.unit.serial
        return read(own if own.is_dir() else settings.pictures)

    def control(self, setup: bytes, data: bytes) -> bytes | None:
        """As the unit."""
        return self.unit.control(setup, data)

    def attached(self, connection: asyncio.StreamWriter | None) -> None:
        """Remember whom to cut off."""
        self._connection = connection
        self._emulator.note("attached" if connection else "detached", serial=self.unit.serial)

    def heed_cable(self) -> None:
        """Do what the fault `unplug` says now."""
        faults = self._emulator.faults
        plugged = not any(faults.lasts(name) for name in self._names("unplug") if name in faults.active)
        if plugged == self._plugged:
            return
        self._plugged = plugged
        self._emulator.note("plugged" if plugged else "unplugged", serial=self.unit.serial)
        if not plugged and self._connection is not None:
            self._connection.transport.abort()

    async def stream(self, bulk: BulkInEndpoint) -> None:
        """A picture at every interval while the host reads; what it is too slow for is left out."""
        loop = asyncio.get_running_loop()
        due_s = loop.time()
        while True:
            await bulk.until_wanted()
            interval_s = self.unit.agreed.interval_s
            due_s = max(due_s, loop.time() - interval_s) + interval_s
            await asyncio.sleep(due_s - loop.time())
            if bulk.wanted:
                await self._expose(bulk)

    async def _expose(self, bulk: BulkInEndpoint) -> None:
        """Send one picture, or what the faults make of it."""
        if self._strikes("unplug"):
            assert self._connection is not None
            self._connection.transport.abort()
        if self._strikes("stall"):
            return
        unit = self.unit
        self._exposed += 1
        picture = self._on_the_wire(self._exposed % len(self.pictures))
        if self._last is not None and self._strikes("freeze"):
            picture = self._last
        self._last = picture
        if self._strikes("short"):
            picture = picture[: int(SHARE_SENT * len(picture))]
        payload = unit.payload(picture, damaged=self._strikes("corrupt"))
        await bulk.send(payload, full=len(payload) == unit.payload_max_bytes)
        self.sent += 1

    def _on_the_wire(self, index: int) -> bytes:
        """A picture in the agreed format; packed once."""
        pixels, size = self.unit.pixels, self.unit.agreed.size
        key = (pixels, size.width_px, index)
        if key not in self._packed:
            self._packed[key] = on_the_wire(self.pictures[index], pixels, size.width_px, size.height_px)
        return self._packed[key]

    def _names(self, fault: str) -> tuple[str, ...]:
        """The fault for all sensors, and that for this one alone."""
        return fault, f"{self.unit.serial}.{fault}"

    def _strikes(self, fault: str) -> bool:
        faults = self._emulator.faults
        return any(faults.strikes(name) for name in self._names(fault))
