"""DIGITs as USB devices over the network: a Linux kernel attaches them as cameras, with faults on demand."""

from __future__ import annotations

import asyncio
import random
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, field_validator

from slipguard.emulator import Report
from slipguard_emulators.base import ControlledEmulator, EmulatorCommand
from slipguard_emulators.digit.frames import encode_image, read, rendered_images, torn_image
from slipguard_emulators.digit.usb_descriptors import PRODUCT_ID, VENDOR_ID
from slipguard_emulators.digit.usbip import BulkInEndpoint, UsbDevice, UsbIpServer
from slipguard_emulators.digit.uvc_device import UvcDevice
from slipguard_emulators.stream_server import StreamServer

Image = NDArray[np.uint8]

FAULTS = {
    "stall": "no image is sent",
    "freeze": "the same image is sent again",
    "corrupt": "an image is sent with the error flag of its USB payload",
    "short": "half of an image is sent as if it were complete",
    "tear": "the first rows of an image are still those of the previous one, without an error flag",
    "unplug": "the cable is pulled; clear it to plug the sensor in again (it must be attached again)",
}
SHARE_SENT = 0.5


class DigitEmulator(ControlledEmulator):
    """Emulate DIGIT cameras as USB devices, for `usbip attach -r HOST -b 1-1` (the second sensor is 1-2).

    A fault affects all sensors, or one if its serial precedes the name: `fault D20002.unplug`.

    Example: `slipguard emulate digit --serial D20001 --fault corrupt:0.01`
    """

    class Settings(BaseModel):
        """The command's options."""

        model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

        serial: Annotated[
            list[str],
            Field(min_length=1, max_length=8, description="Serial number of a sensor; repeat it for more sensors."),
        ] = ["D20001"]
        host: Annotated[str, Field(description="Address to listen on.")] = "127.0.0.1"
        port: Annotated[int, Field(ge=0, le=65535, description="TCP port; 0: any free one.")] = 3240
        pixels: Annotated[Literal["YUYV", "MJPG", "both"], Field(description="Pixel formats on offer.")] = "YUYV"
        firmware: Annotated[
            int, Field(ge=0, le=9999, description="212 is 2.12; below 200 all LEDs have one brightness.")
        ] = 212
        images: Annotated[
            Path | None,
            Field(description="Folder of images, 240 wide x 320 high, or of a folder per serial; default: rendered."),
        ] = None
        object: Annotated[str, Field(description="Object that presses into the gel in the rendered images.")] = "bar"
        seed: Annotated[int, Field(ge=0, description="Random seed.")] = 0

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
        self._server = StreamServer((settings.host, settings.port), UsbIpServer(self.cameras).serve)

    @property
    def address(self) -> str:
        """Host and port."""
        return self._server.path

    @property
    def port(self) -> int:
        """Where it listens; known after `start`."""
        return int(self.address.rpartition(":")[2])

    async def start(self) -> None:
        """Render or read the images and listen. Raises InputError if that is not possible."""
        for camera in self.cameras.values():
            await asyncio.to_thread(getattr, camera, "images")
        self._server.plug()

    async def stop(self) -> None:
        """Disappear."""
        await self._server.close()

    def state(self) -> dict[str, object]:
        """Return the true state."""
        sensors: dict[str, object] = {camera.unit.serial: camera.summary for camera in self.cameras.values()}
        return sensors | {"faults": self.faults.active or "none"}

    def commands(self) -> dict[str, EmulatorCommand]:
        """Return no further commands."""
        return {}

    def fault_changed(self) -> None:
        """Pull or plug cables at once."""
        for camera in self.cameras.values():
            camera.update_cable()


class EmulatedCamera(UsbDevice):
    """One sensor of the emulator: sends images at its rate, with faults."""

    def __init__(self, emulator: DigitEmulator, serial: str, number: int) -> None:
        settings = emulator.settings
        formats = ("YUYV", "MJPG") if settings.pixels == "both" else (settings.pixels,)
        self.unit = UvcDevice(serial, formats, settings.firmware, emulator.note)
        self.sent = 0
        """Number of images sent."""
        self._emulator = emulator
        self._number = number
        self._plugged = True
        self._connection: asyncio.StreamWriter | None = None
        self._packed: dict[tuple[str, int, int], bytes] = {}
        self._last: bytes | None = None
        self._exposed = 0
        self._tears = random.Random(settings.seed + number)

    @property
    def identity(self) -> tuple[int, int, int]:
        """Return the identity of a DIGIT."""
        return VENDOR_ID, PRODUCT_ID, int(str(self.unit.firmware), 16)

    @property
    def plugged(self) -> bool:
        """Whether its cable is plugged in."""
        return self._plugged

    @property
    def summary(self) -> str:
        """Return its state as text."""
        where = "attached" if self._connection else "not attached" if self._plugged else "unplugged"
        return f"{where}, {self.sent} images sent, LEDs {self.unit.zoom:#05x}"

    @cached_property
    def images(self) -> Sequence[Image]:
        """Return the images that it sends in turn, portrait BGR."""
        settings = self._emulator.settings
        if settings.images is None:
            return rendered_images(settings.seed + self._number, settings.object)
        own = settings.images / self.unit.serial
        return read(own if own.is_dir() else settings.images)

    def control(self, setup: bytes, data: bytes) -> bytes | None:
        """See `UvcDevice.control`."""
        return self.unit.control(setup, data)

    def attached(self, connection: asyncio.StreamWriter | None) -> None:
        """Remember the connection of the host."""
        self._connection = connection
        self._emulator.note("attached" if connection else "detached", serial=self.unit.serial)

    def update_cable(self) -> None:
        """Plug or unplug the cable as the fault `unplug` demands."""
        faults = self._emulator.faults
        plugged = not any(faults.lasts(name) for name in self._names("unplug") if name in faults.active)
        if plugged == self._plugged:
            return
        self._plugged = plugged
        self._emulator.note("plugged" if plugged else "unplugged", serial=self.unit.serial)
        if not plugged and self._connection is not None:
            self._connection.transport.abort()

    async def stream(self, bulk: BulkInEndpoint) -> None:
        """Send an image per interval while the host reads; images that it is too slow for are skipped."""
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
        """Send one image, with faults."""
        if self._occurs("unplug"):
            assert self._connection is not None
            self._connection.transport.abort()
        if self._occurs("stall"):
            return
        unit = self.unit
        self._exposed += 1
        index = self._exposed % len(self.images)
        image = self._torn(index) if self._occurs("tear") else self._encoded(index)
        if self._last is not None and self._occurs("freeze"):
            image = self._last
        self._last = image
        if self._occurs("short"):
            image = image[: int(SHARE_SENT * len(image))]
        payload = unit.payload(image, damaged=self._occurs("corrupt"))
        await bulk.send(payload, full=len(payload) == unit.payload_max_bytes)
        self.sent += 1

    def _encoded(self, index: int) -> bytes:
        """Return an image in the negotiated format; each is encoded once."""
        pixels, size = self.unit.pixels, self.unit.agreed.size
        key = (pixels, size.width_px, index)
        if key not in self._packed:
            self._packed[key] = encode_image(self.images[index], pixels, size.width_px, size.height_px)
        return self._packed[key]

    def _torn(self, index: int) -> bytes:
        """Return an image in the negotiated format whose first rows are the previous image's; they end anywhere."""
        size = self.unit.agreed.size
        image = torn_image(self.images[index - 1], self.images[index], self._tears.random())
        return encode_image(image, self.unit.pixels, size.width_px, size.height_px)

    def _names(self, fault: str) -> tuple[str, ...]:
        """Return the name of the fault for all sensors, and for this one."""
        return fault, f"{self.unit.serial}.{fault}"

    def _occurs(self, fault: str) -> bool:
        faults = self._emulator.faults
        return any(faults.occurs(name) for name in self._names(fault))
