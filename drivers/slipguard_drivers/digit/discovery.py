"""Finds the connected DIGITs in the kernel's /sys; needs neither udev nor another program."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from slipguard.errors import DeviceLost

SYSFS = Path("/sys/class/video4linux")
DEV = Path("/dev")
VENDOR_ID, PRODUCT_ID = "2833", "0209"
FIRST_RGB_FIRMWARE = 200
"""Older firmware has one brightness for all three LEDs. Source: Facebook's digit-interface."""


@dataclass(frozen=True, slots=True)
class DigitDevice:
    """One connected DIGIT. port: bus and hub ports, such as `1-4.2`. firmware: None if the number cannot be read."""

    path: Path
    serial: str
    firmware: int | None
    port: str
    usb_mbit_s: float

    @property
    def bus(self) -> str:
        """The USB bus; sensors on one bus share its bandwidth."""
        return self.port.split("-", 1)[0]

    @property
    def has_rgb(self) -> bool:
        """Whether each LED has its own level."""
        return self.firmware is None or self.firmware >= FIRST_RGB_FIRMWARE


def connected_digits(sysfs: Path = SYSFS, dev: Path = DEV) -> list[DigitDevice]:
    """Return all connected DIGITs by serial number, without their metadata nodes, which carry no images."""
    found = []
    for node in sorted(sysfs.glob("video*")):
        try:
            usb = (node / "device").resolve().parent
        except OSError:  # unplugged at this moment
            continue
        if (_attribute(usb / "idVendor"), _attribute(usb / "idProduct")) != (VENDOR_ID, PRODUCT_ID):
            continue
        if _attribute(node / "index") != "0":
            continue
        release, speed = _attribute(usb / "bcdDevice"), _attribute(usb / "speed")
        found.append(
            DigitDevice(
                path=dev / node.name,
                serial=_attribute(usb / "serial"),
                firmware=int(release) if release.isdecimal() else None,
                port=usb.name,
                usb_mbit_s=float(speed) if speed.replace(".", "", 1).isdecimal() else 0.0,
            )
        )
    return sorted(found, key=lambda device: device.serial)


def find_digit(serial: str, name: str, sysfs: Path = SYSFS, dev: Path = DEV) -> DigitDevice:
    """Return the DIGIT with this serial number. Raises DeviceLost naming the connected ones."""
    connected = connected_digits(sysfs, dev)
    for device in connected:
        if device.serial == serial:
            return device
    others = ", ".join(device.serial or "one without a serial number" for device in connected)
    raise DeviceLost(
        f"{name}: no DIGIT with serial {serial} is connected, only {others}; compare with the configuration"
        if others
        else f"{name}: no DIGIT is connected (serial {serial} is configured); check the USB cable"
    )


def _attribute(file: Path) -> str:
    """Return one attribute of the kernel; empty if it does not exist, or the device was just unplugged."""
    try:
        return file.read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return ""
