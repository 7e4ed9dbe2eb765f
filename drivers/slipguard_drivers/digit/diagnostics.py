"""What `slipguard doctor` looks at about a DIGIT from outside: is it plugged in, may we use it, who shares its bus."""

from __future__ import annotations

import grp
import os
from collections.abc import Iterator
from pathlib import Path

from slipguard.diagnosis import CheckResult, note, ok, problem, problem_from_error
from slipguard.errors import DeviceLost
from slipguard_drivers.digit.discovery import DEV, SYSFS, DigitDevice, find_digit, plugged_in
from slipguard_drivers.digit.settings import DigitSettings

RULES = "60-slipguard.rules"
RULES_FOLDERS = tuple(Path(folder) for folder in ("/etc/udev/rules.d", "/run/udev/rules.d", "/usr/lib/udev/rules.d"))
FULL_SPEED_MBIT_S = 480.0
"""USB 2; a slower link carries no 60 fps."""


def check_digit(
    name: str,
    settings: DigitSettings,
    sysfs: Path = SYSFS,
    dev: Path = DEV,
    rules_folders: tuple[Path, ...] = RULES_FOLDERS,
) -> Iterator[CheckResult]:
    """The device; it is not opened. The folders are the system's own, but for tests."""
    try:
        found = find_digit(settings.serial, name, sysfs, dev)
    except DeviceLost as error:
        yield problem_from_error("USB", error, name, "check the USB cable")
        return
    firmware = f"firmware {found.firmware}" if found.firmware is not None else "firmware unknown"
    yield link(found, firmware)
    if not found.has_rgb and len(set(settings.led_rgb)) > 1:
        yield note("LEDs", f"{firmware} has one brightness for all", "give the three levels of led_rgb the same value")
    yield access(found.path)
    yield rules(rules_folders)
    yield neighbours(found, plugged_in(sysfs, dev), settings.fps)


def link(found: DigitDevice, firmware: str) -> CheckResult:
    """Where it is plugged in, and how fast that is."""
    observed = f"{found.path}, serial {found.serial}, {firmware}, port {found.port}, {found.usb_mbit_s:g} Mbit/s"
    if 0.0 < found.usb_mbit_s < FULL_SPEED_MBIT_S:
        return problem("USB", observed, "use another cable or port: this link is too slow for pictures")
    return ok("USB", observed)


def access(path: Path) -> CheckResult:
    """May this user read it."""
    if os.access(path, os.R_OK | os.W_OK):
        return ok("access", f"{path} readable and writable")
    try:
        group = grp.getgrgid(path.stat().st_gid).gr_name
    except (OSError, KeyError):
        group = "video"
    user = os.environ.get("USER", "USER")
    return problem(
        "access",
        f"{path} is not for this user; it belongs to the group {group}",
        f"`sudo usermod -aG {group} {user}`, then log out and in",
    )


def rules(folders: tuple[Path, ...]) -> CheckResult:
    """The udev rules: access for the group, and no autosuspend."""
    for folder in folders:
        if (folder / RULES).is_file():
            return ok("udev rules", str(folder / RULES))
    return note(
        "udev rules",
        f"{RULES} is not installed",
        f"`sudo slipguard install` puts {RULES} in place, then plug the sensors in again",
    )


def neighbours(found: DigitDevice, there: list[DigitDevice], fps: int) -> CheckResult:
    """Sensors on one USB bus share its bandwidth."""
    beside = [one.serial for one in there if one.bus == found.bus and one.serial != found.serial]
    if beside and fps > 30:
        return note(
            "USB bus",
            f"shared with {', '.join(beside)}",
            "it may do; where frames are lost, use ports of different USB controllers",
        )
    return ok("USB bus", f"shared with {', '.join(beside)}" if beside else "not shared with another DIGIT")
