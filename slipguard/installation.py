"""What belongs where on a machine that runs slipguard as a service, and the steps that put it there.

    /etc/systemd/system/slipguard.service    ours: replaced; changes of your own belong to `systemctl edit slipguard`
    /etc/udev/rules.d/60-slipguard.rules     ours: replaced
    /etc/slipguard/config.toml               yours: made once, never overwritten

A plan reads and compares; only carrying it out writes. A second time finds everything in place.
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

from slipguard.atomic_file import write_whole
from slipguard.errors import InputError, SlipguardError

UNIT, RULES, CONFIG = "slipguard.service", "60-slipguard.rules", "config.toml"
PLACES = {
    UNIT: Path("etc/systemd/system") / UNIT,
    RULES: Path("etc/udev/rules.d") / RULES,
    CONFIG: Path("etc/slipguard") / CONFIG,
}
SHIPPED_EXECUTABLE = "/opt/slipguard/bin/slipguard"
"""What the unit says as it is shipped."""
GROUPS = ("video", "dialout")
"""Whose members may use cameras and serial ports; the unit asks for both."""
HIDDEN = ("/home", "/root", "/run/user", "/tmp", "/var/tmp")
"""Folders that the unit's ProtectHome and PrivateTmp keep from the service."""
MODE = 0o644
COMMAND_TIMEOUT_S = 60.0
TELL_SYSTEMD = ("systemctl", "daemon-reload")
TELL_UDEV = (
    ("udevadm", "control", "--reload"),
    # The rules ask for an added device; what is plugged in already is presented as one.
    ("udevadm", "trigger", "--action=add", "--subsystem-match=usb", "--attr-match=idVendor=2833"),
    ("udevadm", "trigger", "--action=add", "--subsystem-match=video4linux", "--subsystem-match=usb-serial"),
    ("udevadm", "trigger", "--action=add", "--subsystem-match=tty"),
)
END_SERVICE = ("systemctl", "disable", "--now", UNIT)


class Do(StrEnum):
    """What a step does; the last three change nothing."""

    WRITE = "write"
    REPLACE = "replace"
    REMOVE = "remove"
    RUN = "run"
    SAME = "same"
    KEEP = "keep"
    SKIP = "skip"


@dataclass(frozen=True, slots=True)
class Step:
    """One step. what: file or command. why: said beside it. diff: what replacing it changes, as `diff -u` would."""

    do: Do
    what: str
    why: str = ""
    content: str = ""
    diff: str = ""


@dataclass(frozen=True, slots=True)
class Live:
    """Who runs and can be told of changes; a container has systemd and no udev."""

    systemd: bool
    udev: bool


def shipped(name: str) -> str:
    """The text of UNIT, RULES or CONFIG, from the installed package or the checkout. Raises InputError."""
    checkout = Path(__file__).resolve().parents[1]
    places = (
        Path(str(resources.files("slipguard"))) / "systemd" / name,
        checkout / (CONFIG if name == CONFIG else f"systemd/{name}"),
    )
    for path in places:
        if path.is_file():
            return path.read_text(encoding="utf-8")
    raise InputError(f"{name} is in neither {places[0].parent} nor {places[1].parent}; install slipguard again")


def unit_text(executable: Path) -> str:
    """The unit that starts this executable. Raises InputError where systemd could not read its path."""
    if not executable.is_absolute() or any(one.isspace() or one in "%\"'\\$" for one in str(executable)):
        raise InputError(f"{executable}: the service needs an absolute path without spaces, quotes, % and $")
    return shipped(UNIT).replace(SHIPPED_EXECUTABLE, str(executable))


def to_install(root: Path, executable: Path, config: str | None, live: Live) -> Iterator[Step]:
    """The steps that put all in place under `root`.

    config: the text of a configuration; None: the commented one that is shipped, where there is none. live: who is to
    be told. Raises InputError or OSError.
    """
    yield _ours(root, UNIT, unit_text(executable))
    yield _ours(root, RULES, shipped(RULES))
    yield _yours(root / PLACES[CONFIG], config)
    yield _told(TELL_SYSTEMD, live)
    for words in TELL_UDEV:
        yield _told(words, live)


def to_remove(root: Path, live: Live) -> Iterator[Step]:
    """The steps that take unit and rules away again; configuration and state stay. Raises OSError."""
    there = [root / PLACES[name] for name in (UNIT, RULES) if (root / PLACES[name]).exists()]
    if root / PLACES[UNIT] in there:
        yield _told(END_SERVICE, live)
    for path in there:
        yield Step(Do.REMOVE, str(path))
    if (root / PLACES[CONFIG]).exists():
        yield Step(Do.KEEP, str(root / PLACES[CONFIG]), "yours")
    if there:
        yield _told(TELL_SYSTEMD, live)
        yield _told(TELL_UDEV[0], live)


def _ours(root: Path, name: str, text: str) -> Step:
    path = root / PLACES[name]
    if not path.exists():
        return Step(Do.WRITE, str(path), content=text)
    before = path.read_text(encoding="utf-8", errors="replace")
    if before == text and stat.S_IMODE(path.stat().st_mode) == MODE:
        return Step(Do.SAME, str(path))
    return Step(Do.REPLACE, str(path), content=text, diff=_difference(before, text, str(path)))


def _yours(path: Path, config: str | None) -> Step:
    if not path.exists():
        why = "fill in serial numbers, serial port and the robot's address" if config is None else ""
        return Step(Do.WRITE, str(path), why, content=shipped(CONFIG) if config is None else config)
    before = path.read_text(encoding="utf-8", errors="replace")
    if config is None:
        return Step(Do.KEEP, str(path), "yours")
    if before == config:
        return Step(Do.SAME, str(path))
    why = "yours, and different from the one given; to replace it move it away first"
    return Step(Do.KEEP, str(path), why, diff=_difference(before, config, str(path)))


def _told(words: Sequence[str], live: Live) -> Step:
    who, listens = ("systemd", live.systemd) if words[0] == "systemctl" else ("udev", live.udev)
    return Step(Do.RUN if listens else Do.SKIP, " ".join(words), "" if listens else f"no {who} is running there")


def _difference(before: str, after: str, name: str) -> str:
    lines = difflib.unified_diff(before.splitlines(), after.splitlines(), f"{name} (there)", f"{name} (new)", "", "", 1)
    return "\n".join(line.rstrip("\n") for line in lines)


def carry_out(step: Step) -> None:
    """Do one step. Raises OSError, or SlipguardError where a command fails."""
    if step.do in (Do.WRITE, Do.REPLACE):
        write_whole(Path(step.what), step.content.encode(), MODE)
    elif step.do is Do.REMOVE:
        Path(step.what).unlink(missing_ok=True)
    elif step.do is Do.RUN:
        _run(step.what)


def _run(command: str) -> None:
    try:
        done = subprocess.run(command.split(), capture_output=True, text=True, timeout=COMMAND_TIMEOUT_S, check=False)
    except FileNotFoundError:
        raise SlipguardError(f"`{command}`: not found; is systemd installed?") from None
    except subprocess.TimeoutExpired:
        raise SlipguardError(f"`{command}` did not end in {COMMAND_TIMEOUT_S:g} s; run it by hand") from None
    if done.returncode:
        said = " ".join((done.stderr or done.stdout).split())[-300:]
        raise SlipguardError(f"`{command}` failed ({done.returncode}): {said or 'it says nothing'}")


def out_of_reach(path: Path) -> str | None:
    """Why the service, a user without rights and without home folders, cannot use a file; None if it can."""
    real = path.resolve()
    for one in (path, real):
        for folder in HIDDEN:
            if one.is_relative_to(folder):
                return f"{one} is in {folder}, which the service does not see"
    try:
        for one in (real, *real.parents):
            if not one.stat().st_mode & stat.S_IXOTH:
                return f"{one} is closed to other users"
    except OSError as error:
        return f"{error.filename}: {error.strerror}"
    return None


def missing_groups() -> list[str]:
    """Groups that the unit names and this machine does not have; the service would not start."""
    import grp

    there = {entry.gr_name for entry in grp.getgrall()}
    return [name for name in GROUPS if name not in there]


def live(root: Path) -> Live:
    """Whom to tell of changes under `root`: nobody unless it is this machine's own."""
    here = root.resolve() == Path("/")
    return Live(here and os.path.isdir("/run/systemd/system"), here and os.path.exists("/run/udev/control"))
