"""The whole examination: this machine, the daemon, the four devices; each line as it is found."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from slipguard.config import GROUP_OF, Config
from slipguard.daemon.api.client import Client, DaemonNotRunning
from slipguard.daemon.store.state_dir import StateDir
from slipguard.devices import DriverContext
from slipguard.diagnosis import Diagnosable, Finding, Verdict, fine, from_error, note, wrong
from slipguard.doctor import gripper, machine, sensor, through_daemon
from slipguard.doctor.through_daemon import LOOK_S, Looks
from slipguard.errors import SlipguardError
from slipguard.registry import load_driver

DEVICE_S = 30.0
"""A look at one device that takes longer is given up."""
FINGERS = ("left", "right")


@dataclass(frozen=True, slots=True)
class Line:
    """One finding and what it is about: machine, daemon, left, right, gripper or arm."""

    subject: str
    finding: Finding


async def examine(config: Config, socket: Path, tell: Callable[[str], None]) -> list[Line]:
    """Look at everything; `tell` hears what is being done. All four devices at once: so they are used, too."""
    tell("this machine")
    lines = [Line("machine", finding) for finding in machine.look(config)]
    tell("the daemon")
    looks, said = await asyncio.to_thread(_ask_daemon, socket), []
    if isinstance(looks, Looks):
        said = list(through_daemon.daemon(looks))
    else:
        said = [looks]
        if looks.verdict is Verdict.WRONG:
            return [*lines, Line("daemon", looks)]  # it may have the devices; opening them could upset it
    lines += [Line("daemon", finding) for finding in said]
    tell("cameras, gripper and arm")
    running = looks if isinstance(looks, Looks) else None
    found = await asyncio.gather(*(_device(name, config, running) for name in GROUP_OF))
    for name, findings in zip(GROUP_OF, found, strict=True):
        lines += [Line(name, finding) for finding in findings]
    return lines


def _ask_daemon(socket: Path) -> Looks | Finding:
    """Two looks at a running daemon; or that none runs, or that it cannot be asked."""
    try:
        with Client(socket) as client:
            before = client.state()
            threading.Event().wait(LOOK_S)
            return Looks(before, client.state(), LOOK_S)
    except DaemonNotRunning:
        return fine("daemon", "none runs; the devices were opened for this look and closed again")
    except SlipguardError as error:
        return from_error("daemon", error, "", "stop it (`systemctl stop slipguard`) and run the doctor again")
    except (KeyError, TypeError, ValueError) as error:
        return wrong("daemon", f"answers what this version does not understand ({error})", "restart it")


async def _device(name: str, config: Config, looks: Looks | None) -> list[Finding]:
    """All findings on one device; whatever its driver does wrong is one more finding."""
    section = getattr(config, name)
    found: list[Finding] = []
    keep = found.append  # one by one: what was found before a failure counts
    try:
        async with asyncio.timeout(DEVICE_S):
            driver = load_driver(GROUP_OF[name], section.driver)
            device = driver(section.settings, DriverContext(name, mode=config.guard.mode))
            async for finding in _looks_at(name, device, section, config, looks):
                keep(finding)
    except TimeoutError:
        found.append(wrong("look", f"did not end in {DEVICE_S:g} s", "unplug the device, plug it in and try again"))
    except SlipguardError as error:
        found.append(from_error("driver", error, name, "check its section in the configuration"))
    except OSError as error:
        what = f"{error.filename or section.driver}: {error.strerror or error}"
        found.append(wrong("driver", what, "check that path in the configuration, and who may read it"))
    except Exception as error:
        what = f"driver {section.driver!r} failed: {type(error).__name__}: {error}"
        found.append(wrong("driver", " ".join(what.split()), "tell the maker of the driver"))
    return found


async def _looks_at(
    name: str, device: Any, section: Any, config: Config, looks: Looks | None
) -> AsyncIterator[Finding]:
    """First what the driver's own look finds; then the port's, unless that has already found it out of order."""
    told: dict[str, Verdict] = {}
    if isinstance(device, Diagnosable):
        async for finding in device.diagnose(owned=looks is not None):
            told[finding.what] = finding.verdict
            yield finding
    store = StateDir(config.state.directory)
    if looks is not None:
        about = through_daemon.finger(name, looks, section.settings, store) if name in FINGERS else None
        for finding in about or through_daemon.actuator(name, looks):
            if finding.what not in told:
                yield finding
    elif Verdict.WRONG in told.values():
        return
    elif name in FINGERS:
        async for finding in sensor.look(name, device, section.settings, store):
            yield finding
    elif name == "gripper":
        async for finding in gripper.look(name, device):
            yield finding
    elif not isinstance(device, Diagnosable):
        yield note(
            "arm",
            f"driver {section.driver!r} has no look of its own, and opening an arm may take control of it",
            "`slipguard run` will say whether it answers",
        )
