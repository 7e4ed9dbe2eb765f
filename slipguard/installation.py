"""Install slipguard as a service: the files, and the steps that install or remove them.

    /etc/systemd/system/slipguard.service    replaced by each installation; make changes with `systemctl edit slipguard`
    /etc/udev/rules.d/60-slipguard.rules     replaced by each installation
    /etc/slipguard/config.toml               the user's: written once, never overwritten

Planning the steps only reads and compares; `carry_out` writes. Installing twice changes nothing.
"""

from __future__ import annotations

import difflib
import os
import stat
import subprocess
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from importlib import resources
from pathlib import Path

from slipguard.atomic_file import write_atomically
from slipguard.errors import InputError, SlipguardError

UNIT, RULES, CONFIG = "slipguard.service", "60-slipguard.rules", "config.toml"
PLACES = {
    UNIT: Path("etc/systemd/system") / UNIT,
    RULES: Path("etc/udev/rules.d") / RULES,
    CONFIG: Path("etc/slipguard") / CONFIG,
}
SHIPPED_EXECUTABLE = "/opt/slipguard/bin/slipguard"
"""Executable in the included unit; replaced by the installed one."""
GROUPS = ("video", "dialout")
"""Groups with access to cameras and serial ports; the unit uses both."""
HIDDEN = ("/home", "/root", "/run/user", "/tmp", "/var/tmp")
"""Folders that the unit's ProtectHome and PrivateTmp hide from the service."""
MODE = 0o644
COMMAND_TIMEOUT_S = 60.0
RELOAD_SYSTEMD = ("systemctl", "daemon-reload")
RELOAD_UDEV = (
    ("udevadm", "control", "--reload"),
    # The rules apply to added devices; trigger this event for devices that are already plugged in.
    ("udevadm", "trigger", "--action=add", "--subsystem-match=usb", "--attr-match=idVendor=2833"),
    ("udevadm", "trigger", "--action=add", "--subsystem-match=video4linux", "--subsystem-match=usb-serial"),
    ("udevadm", "trigger", "--action=add", "--subsystem-match=tty"),
)
STOP_SERVICE = ("systemctl", "disable", "--now", UNIT)


class StepAction(StrEnum):
    """What a step does; the last three change nothing."""

    WRITE = "write"
    REPLACE = "replace"
    REMOVE = "remove"
    RUN = "run"
    SAME = "same"
    KEEP = "keep"
    SKIP = "skip"


@dataclass(frozen=True, slots=True)
class InstallStep:
    """One step. what: file or command. why: explanation. diff: what replacing the file changes, as `diff -u`."""

    do: StepAction
    what: str
    why: str = ""
    content: str = ""
    diff: str = ""


@dataclass(frozen=True, slots=True)
class RunningServices:
    """Which services run and can reload; a container has systemd but no udev."""

    systemd: bool
    udev: bool


def included_file(name: str) -> str:
    """Return the text of UNIT, RULES or CONFIG from the installed package or the checkout. Raises InputError."""
    checkout = Path(__file__).resolve().parents[1]
    places = (
        Path(str(resources.files("slipguard"))) / "systemd" / name,
        checkout / (CONFIG if name == CONFIG else f"systemd/{name}"),
    )
    for path in places:
        if path.is_file():
            return path.read_text(encoding="utf-8")
    raise InputError(f"{name} not found in {places[0].parent} and {places[1].parent}; install slipguard again")


def unit_text(executable: Path) -> str:
    """Return the unit for this executable. Raises InputError if systemd cannot read its path."""
    if not executable.is_absolute() or any(one.isspace() or one in "%\"'\\$" for one in str(executable)):
        raise InputError(f"{executable}: the service needs an absolute path without spaces, quotes, % and $")
    return included_file(UNIT).replace(SHIPPED_EXECUTABLE, str(executable))


def to_install(root: Path, executable: Path, config: str | None, running: RunningServices) -> Iterator[InstallStep]:
    """Yield the steps of an installation under `root`.

    Args:
        root: Root of the file system.
        executable: The installed `slipguard`.
        config: Text of a configuration; None for the included commented one if none exists.
        running: Services that are to reload.

    Raises:
        InputError: The executable's path is not possible, or an included file is missing.
        SlipguardError: The unit or the rules are masked.
        OSError: A file cannot be read.
    """
    yield _replaced_file(root, UNIT, unit_text(executable))
    yield _replaced_file(root, RULES, included_file(RULES))
    yield _user_file(root / PLACES[CONFIG], config)
    yield _reload(RELOAD_SYSTEMD, running)
    for command in RELOAD_UDEV:
        yield _reload(command, running)


def to_remove(root: Path, running: RunningServices) -> Iterator[InstallStep]:
    """Yield the steps that remove unit and rules; configuration and state stay. Raises OSError."""
    places = [root / PLACES[name] for name in (UNIT, RULES)]
    existing = [path for path in places if path.exists() and not _is_masked(path)]
    if root / PLACES[UNIT] in existing:
        yield _reload(STOP_SERVICE, running)
    for path in existing:
        yield InstallStep(StepAction.REMOVE, str(path))
    if (root / PLACES[CONFIG]).exists():
        yield InstallStep(StepAction.KEEP, str(root / PLACES[CONFIG]), "your own file")
    if existing:
        yield _reload(RELOAD_SYSTEMD, running)
        yield _reload(RELOAD_UDEV[0], running)


def _replaced_file(root: Path, name: str, text: str) -> InstallStep:
    path = root / PLACES[name]
    if _is_masked(path):
        undo = f"systemctl unmask {name}" if name == UNIT else f"rm {path}"
        raise SlipguardError(f"{path} leads to /dev/null: it was switched off on purpose; `{undo}`, then install again")
    if not path.exists():
        return InstallStep(StepAction.WRITE, str(path), content=text)
    before = path.read_text(encoding="utf-8", errors="replace")
    if before == text and stat.S_IMODE(path.stat().st_mode) == MODE:
        return InstallStep(StepAction.SAME, str(path))
    return InstallStep(StepAction.REPLACE, str(path), content=text, diff=_difference(before, text, str(path)))


def _is_masked(path: Path) -> bool:
    """Return whether an administrator has switched a unit or rule off (`systemctl mask`)."""
    return path.is_symlink() and os.readlink(path) == os.devnull


def _user_file(path: Path, config: str | None) -> InstallStep:
    if not path.exists():
        why = "fill in serial numbers, serial port and the robot's address" if config is None else ""
        return InstallStep(
            StepAction.WRITE, str(path), why, content=included_file(CONFIG) if config is None else config
        )
    before = path.read_text(encoding="utf-8", errors="replace")
    if config is None:
        return InstallStep(StepAction.KEEP, str(path), "your own file")
    if before == config:
        return InstallStep(StepAction.SAME, str(path))
    why = "your own file differs from --config; move it away to replace it"
    return InstallStep(StepAction.KEEP, str(path), why, diff=_difference(before, config, str(path)))


def _reload(command: Sequence[str], running: RunningServices) -> InstallStep:
    name, runs = ("systemd", running.systemd) if command[0] == "systemctl" else ("udev", running.udev)
    action = StepAction.RUN if runs else StepAction.SKIP
    return InstallStep(action, " ".join(command), "" if runs else f"{name} is not running there")


def _difference(before: str, after: str, name: str) -> str:
    lines = difflib.unified_diff(
        before.splitlines(), after.splitlines(), f"{name} (present)", f"{name} (new)", "", "", 1
    )
    return "\n".join(line.rstrip("\n") for line in lines)


def carry_out(step: InstallStep) -> None:
    """Carry out one step. Raises OSError, or SlipguardError if a command fails."""
    if step.do in (StepAction.WRITE, StepAction.REPLACE):
        write_atomically(Path(step.what), step.content.encode(), MODE)
    elif step.do is StepAction.REMOVE:
        Path(step.what).unlink(missing_ok=True)
    elif step.do is StepAction.RUN:
        _run(step.what)


def _run(command: str) -> None:
    try:
        done = subprocess.run(command.split(), capture_output=True, text=True, timeout=COMMAND_TIMEOUT_S, check=False)
    except FileNotFoundError:
        raise SlipguardError(f"`{command}`: not found; install systemd, or run it by hand") from None
    except subprocess.TimeoutExpired:
        raise SlipguardError(f"`{command}` did not end within {COMMAND_TIMEOUT_S:g} s; run it by hand") from None
    if done.returncode:
        output = " ".join((done.stderr or done.stdout).split())[-300:]
        raise SlipguardError(f"`{command}` failed ({done.returncode}): {output or 'no output'}")


def out_of_reach(path: Path) -> str | None:
    """Return why the service, which has no rights and no home folders, cannot use a file; None if it can."""
    real = path.resolve()
    for one in (path, real):
        for folder in HIDDEN:
            if one.is_relative_to(folder):
                return f"{one} is in {folder}, which is hidden from the service"
    try:
        for one in (real, *real.parents):
            if not one.stat().st_mode & stat.S_IXOTH:
                return f"{one} is not accessible to other users"
    except OSError as error:
        return f"{error.filename}: {error.strerror}"
    return None


def missing_groups() -> list[str]:
    """Return the groups of the unit that do not exist here; the service would not start without them."""
    import grp

    existing = {entry.gr_name for entry in grp.getgrall()}
    return [name for name in GROUPS if name not in existing]


def running_services(root: Path) -> RunningServices:
    """Return which services are to reload after changes under `root`: none unless it is this machine's root."""
    here = root.resolve() == Path("/")
    return RunningServices(here and os.path.isdir("/run/systemd/system"), here and os.path.exists("/run/udev/control"))
