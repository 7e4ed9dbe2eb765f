"""Which DIGITs are plugged in, from what the kernel says in /sys: no udev, no other program needed."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from slipguard.errors import DeviceLost

SYSFS = Path("/sys/class/video4linux")
DEV = Path("/dev")
VENDOR_ID, PRODUCT_ID = "2833", "0209"
FIRST_RGB_FIRMWARE = 200
"""Older firmware has one brightness for all three LEDs (Facebook's digit-interface)."""


@dataclass(frozen=True, slots=True)
class DigitDevice:
    """One DIGIT. port: bus and hub ports, such as `1-4.2`. firmware: None where the number cannot be read."""

    path: Path
    serial: str
    firmware: int | None
    port: str
    usb_mbit_s: float

    @property
    def bus(self) -> str:
        """Sensors on one bus share its bandwidth."""
        return self.port.split("-", 1)[0]

    @property
    def has_rgb(self) -> bool:
        """Whether each LED has its own level."""
        return self.firmware is None or self.firmware >= FIRST_RGB_FIRMWARE


def plugged_in(sysfs: Path = SYSFS, dev: Path = DEV) -> list[DigitDevice]:
    """All DIGITs, by serial. A camera's second node, which carries no pictures, is left out."""
    found = []
    for node in sorted(sysfs.glob("video*")):
        try:
            usb = (node / "device").resolve().parent
        except OSError:  # it was unplugged in this moment: a link that was there cannot be read any more
            continue
        if (_word(usb / "idVendor"), _word(usb / "idProduct")) != (VENDOR_ID, PRODUCT_ID):
            continue
        if _word(node / "index") != "0":
            continue
        release, speed = _word(usb / "bcdDevice"), _word(usb / "speed")
        found.append(
            DigitDevice(
                path=dev / node.name,
                serial=_word(usb / "serial"),
                firmware=int(release) if release.isdecimal() else None,
                port=usb.name,
                usb_mbit_s=float(speed) if speed.replace(".", "", 1).isdecimal() else 0.0,
            )
        )
    return sorted(found, key=lambda one: one.serial)


def find_digit(serial: str, name: str, sysfs: Path = SYSFS, dev: Path = DEV) -> DigitDevice:
    """The DIGIT with this serial number. Raises DeviceLost naming those there are."""
    there = plugged_in(sysfs, dev)
    for one in there:
        if one.serial == serial:
            return one
    others = ", ".join(one.serial or "one without a serial" for one in there)
    raise DeviceLost(
        f"{name}: no DIGIT with serial {serial} is plugged in, there is {others}; compare with the configuration"
        if others
        else f"{name}: no DIGIT is plugged in, {serial} is looked for; check the USB cable"
    )


def _word(file: Path) -> str:
    """One attribute of the kernel; empty where there is none, or the device has just gone."""
    try:
        return file.read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return ""
