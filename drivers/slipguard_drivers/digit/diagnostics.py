"""Checks of `slipguard doctor` on a DIGIT from outside: connected, accessible, and which sensors share its bus."""

from __future__ import annotations

import grp
import os
from collections.abc import Iterator
from pathlib import Path

from slipguard.diagnosis import CheckResult, note, ok, problem, problem_from_error
from slipguard.errors import DeviceLost
from slipguard_drivers.digit.discovery import DEV, SYSFS, DigitDevice, connected_digits, find_digit
from slipguard_drivers.digit.stream_setup import DigitSettings, stream_bytes_s
from slipguard_drivers.digit.usb_bandwidth import BUS_BYTES, cameras_on_bus, reserved_bytes

RULES = "60-slipguard.rules"
RULES_FOLDERS = tuple(Path(folder) for folder in ("/etc/udev/rules.d", "/run/udev/rules.d", "/usr/lib/udev/rules.d"))
USB2_MBIT_S = 480.0
"""A slower link does not carry 60 frames per second."""


def check_digit(
    name: str,
    settings: DigitSettings,
    sysfs: Path = SYSFS,
    dev: Path = DEV,
    rules_folders: tuple[Path, ...] = RULES_FOLDERS,
) -> Iterator[CheckResult]:
    """Make all checks; the device is not opened. The folders are the system's own, except in tests."""
    try:
        device = find_digit(settings.serial, name, sysfs, dev)
    except DeviceLost as error:
        yield problem_from_error("USB", error, name, "check the USB cable")
        return
    firmware = f"firmware {device.firmware}" if device.firmware is not None else "firmware unknown"
    yield check_link(device, firmware)
    if not device.has_rgb and len(set(settings.led_rgb)) > 1:
        yield note("LEDs", f"{firmware} has one brightness for all", "give the three levels of led_rgb the same value")
    yield check_access(device.path)
    yield check_udev_rules(rules_folders)
    yield check_bandwidth(
        device, connected_digits(sysfs, dev), settings, sysfs.parent.parent / "bus" / "usb" / "devices"
    )


def check_link(device: DigitDevice, firmware: str) -> CheckResult:
    """Check the speed of the USB link."""
    observed = f"{device.path}, serial {device.serial}, {firmware}, port {device.port}, {device.usb_mbit_s:g} Mbit/s"
    if 0.0 < device.usb_mbit_s < USB2_MBIT_S:
        return problem("USB", observed, f"use another cable or port: images need {USB2_MBIT_S:g} Mbit/s")
    return ok("USB", observed)


def check_access(path: Path) -> CheckResult:
    """Check whether this user may read and write the device."""
    if os.access(path, os.R_OK | os.W_OK):
        return ok("access", f"{path} readable and writable")
    try:
        group = grp.getgrgid(path.stat().st_gid).gr_name
    except (OSError, KeyError):
        group = "video"
    user = os.environ.get("USER", "USER")
    return problem(
        "access",
        f"{path} is not accessible for this user; it belongs to the group {group}",
        f"`sudo usermod -aG {group} {user}`, then log out and in",
    )


def check_udev_rules(folders: tuple[Path, ...]) -> CheckResult:
    """Check for the udev rules, which give the group access and prevent autosuspend."""
    for folder in folders:
        if (folder / RULES).is_file():
            return ok("udev rules", str(folder / RULES))
    return note(
        "udev rules",
        f"{RULES} is not installed",
        f"`sudo slipguard install` adds {RULES}; then plug the sensors in again",
    )


def check_bandwidth(
    device: DigitDevice, connected: list[DigitDevice], settings: DigitSettings, devices: Path
) -> CheckResult:
    """Add up what the cameras on the sensor's USB bus reserve; a DIGIT is taken to have this one's mode.

    devices: /sys/bus/usb/devices. Another camera counts with what it reserves now, or with its largest size.
    """
    digits = {other.port: other.serial for other in connected}
    cameras = list(cameras_on_bus(devices, device.bus))
    others = [digits.get(port, f"a camera at port {port}") for port, _, _ in cameras if port != device.port]
    others = others or [other.serial for other in connected if other.bus == device.bus and other.port != device.port]
    shared = f"shared with {', '.join(others)}" if others else "not shared with another camera"

    def total(fps: int) -> int:
        needed_bytes_s = stream_bytes_s("MJPG" if settings.pixels == "MJPG" else "YUYV", fps)
        return sum(
            reserved_bytes(sizes, needed_bytes_s) if port in digits else sizes.get(present, max(sizes.values()))
            for port, sizes, present in cameras
        )

    needed = total(settings.fps)
    observed = f"{shared}; its cameras reserve {needed / BUS_BYTES:.0%} of what it can carry" if cameras else shared
    if needed <= BUS_BYTES:
        return ok("USB bus", observed)
    modes = 'pixels = "MJPG" or fps = 30' if settings.fps > 30 and total(30) <= BUS_BYTES else 'pixels = "MJPG"'
    return problem("USB bus", observed, f"use a port of another USB controller for one of them, or set {modes}")
