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
from slipguard.diagnosis import CheckResult, CheckStatus, Diagnosable, note, ok, problem, problem_from_error
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
    result: CheckResult


async def examine(config: Config, socket: Path, tell: Callable[[str], None]) -> list[Line]:
    """Look at everything; `tell` hears what is being done. All four devices at once: so they are used, too."""
    tell("this machine")
    lines = [Line("machine", result) for result in machine.look(config)]
    tell("the daemon")
    looks, said = await asyncio.to_thread(_ask_daemon, socket), []
    if isinstance(looks, Looks):
        said = list(through_daemon.daemon(looks))
    else:
        said = [looks]
        if looks.status is CheckStatus.PROBLEM:
            return [*lines, Line("daemon", looks)]  # it may have the devices; opening them could upset it
    lines += [Line("daemon", result) for result in said]
    tell("cameras, gripper and arm")
    running = looks if isinstance(looks, Looks) else None
    found = await asyncio.gather(*(_device(name, config, running) for name in GROUP_OF))
    for name, results in zip(GROUP_OF, found, strict=True):
        lines += [Line(name, result) for result in results]
    return lines


def _ask_daemon(socket: Path) -> Looks | CheckResult:
    """Two looks at a running daemon; or that none runs, or that it cannot be asked."""
    try:
        with Client(socket) as client:
            before = client.state()
            threading.Event().wait(LOOK_S)
            return Looks(before, client.state(), LOOK_S)
    except DaemonNotRunning:
        return ok("daemon", "none runs; the devices were opened for this look and closed again")
    except SlipguardError as error:
        return problem_from_error("daemon", error, "", "stop it (`systemctl stop slipguard`) and run the doctor again")
    except (KeyError, TypeError, ValueError) as error:
        return problem("daemon", f"answers what this version does not understand ({error})", "restart it")


async def _device(name: str, config: Config, looks: Looks | None) -> list[CheckResult]:
    """All findings on one device; whatever its driver does wrong is one more finding."""
    section = getattr(config, name)
    found: list[CheckResult] = []
    keep = found.append  # one by one: what was found before a failure counts
    try:
        async with asyncio.timeout(DEVICE_S):
            driver = load_driver(GROUP_OF[name], section.driver)
            device = driver(section.settings, DriverContext(name, mode=config.guard.mode))
            async for result in _looks_at(name, device, section, config, looks):
                keep(result)
    except TimeoutError:
        found.append(problem("look", f"did not end in {DEVICE_S:g} s", "unplug the device, plug it in and try again"))
    except SlipguardError as error:
        found.append(problem_from_error("driver", error, name, "check its section in the configuration"))
    except OSError as error:
        check = f"{error.filename or section.driver}: {error.strerror or error}"
        found.append(problem("driver", check, "check that path in the configuration, and who may read it"))
    except Exception as error:
        check = f"driver {section.driver!r} failed: {type(error).__name__}: {error}"
        found.append(problem("driver", " ".join(check.split()), "tell the maker of the driver"))
    return found


async def _looks_at(
    name: str, device: Any, section: Any, config: Config, looks: Looks | None
) -> AsyncIterator[CheckResult]:
    """First what the driver's own look finds; then the port's, unless that has already found it out of order."""
    told: dict[str, CheckStatus] = {}
    if isinstance(device, Diagnosable):
        async for result in device.diagnose(owned=looks is not None):
            told[result.check] = result.status
            yield result
    store = StateDir(config.state.directory)
    if looks is not None:
        about = through_daemon.finger(name, looks, section.settings, store) if name in FINGERS else None
        for result in about or through_daemon.actuator(name, looks):
            if result.check not in told:
                yield result
    elif CheckStatus.PROBLEM in told.values():
        return
    elif name in FINGERS:
        async for result in sensor.look(name, device, section.settings, store):
            yield result
    elif name == "gripper":
        async for result in gripper.look(name, device):
            yield result
    elif not isinstance(device, Diagnosable):
        yield note(
            "arm",
            f"driver {section.driver!r} has no look of its own, and opening an arm may take control of it",
            "`slipguard run` will say whether it answers",
        )
