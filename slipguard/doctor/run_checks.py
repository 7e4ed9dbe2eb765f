"""Run all checks: the machine, the daemon, the four devices."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from slipguard.config import GROUP_OF, Config
from slipguard.config_errors import describe_validation_error
from slipguard.daemon.api.client import Client, DaemonNotRunning
from slipguard.daemon.api.state import State, StoredBackgrounds
from slipguard.daemon.store.state_dir import StateDir
from slipguard.devices import FINGERS, DriverContext
from slipguard.diagnosis import CheckResult, CheckStatus, Diagnosable, note, ok, problem, problem_from_error
from slipguard.doctor import gripper, machine, sensor, through_daemon
from slipguard.doctor.through_daemon import OBSERVE_S, DaemonSamples
from slipguard.errors import SlipguardError
from slipguard.registry import build_device

DEVICE_S = 30.0
"""Time limit for the checks of one device."""


@dataclass(frozen=True, slots=True)
class SubjectCheck:
    """One result and its subject: machine, daemon, left, right, gripper or arm."""

    subject: str
    result: CheckResult


async def run_checks(config: Config, socket: Path, report: Callable[[str], None]) -> list[SubjectCheck]:
    """Run all checks; the four devices at the same time, as in use.

    Args:
        config: The checked configuration.
        socket: Socket of a running daemon.
        report: Receives what is being checked.
    """
    report("this machine")
    checks = [SubjectCheck("machine", result) for result in machine.check_machine(config)]
    report("the daemon")
    samples = await asyncio.to_thread(_sample_daemon, socket)
    if isinstance(samples, DaemonSamples):
        # The daemon reports what it cannot write; as another user, it has another state folder.
        checks = [one for one in checks if one.result.check != "state folder"]
        checks += [SubjectCheck("daemon", result) for result in through_daemon.check_daemon(samples)]
    else:
        checks.append(SubjectCheck("daemon", samples))
        if samples.status is CheckStatus.PROBLEM:
            return checks  # a daemon may have the devices; opening them could disturb it
    report("cameras, gripper and arm")
    running = samples if isinstance(samples, DaemonSamples) else None
    results = await asyncio.gather(*(_check_device(name, config, running) for name in GROUP_OF))
    for name, found in zip(GROUP_OF, results, strict=True):
        checks += [SubjectCheck(name, result) for result in found]
    return checks


def _sample_daemon(socket: Path) -> DaemonSamples | CheckResult:
    """Return two states of the running daemon, or the result that none runs or responds."""
    try:
        with Client(socket) as client:
            before = State.model_validate(client.state())
            threading.Event().wait(OBSERVE_S)
            after = State.model_validate(client.state())
            stored = {name: StoredBackgrounds.model_validate(one) for name, one in client.backgrounds().items()}
            return DaemonSamples(before, after, OBSERVE_S, stored)
    except DaemonNotRunning:
        return ok("daemon", "none runs; the devices were opened for this check and closed again")
    except SlipguardError as error:
        return problem_from_error("daemon", error, "", "stop it (`systemctl stop slipguard`) and run the doctor again")
    except ValidationError as error:
        what = describe_validation_error(error)
        return problem("daemon", f"its response is not valid for this version ({what})", "restart it")


async def _check_device(name: str, config: Config, samples: DaemonSamples | None) -> list[CheckResult]:
    """Return all results for one device; a failure of its driver is one more result."""
    section = getattr(config, name)
    results: list[CheckResult] = []
    try:
        async with asyncio.timeout(DEVICE_S):
            context = DriverContext(name, mode=config.guard.mode)
            device = build_device(GROUP_OF[name], section.driver, section.settings, context)
            async for result in _device_checks(name, device, section, config, samples):
                results += [result]  # one by one, so that results before a failure are kept
    except TimeoutError:
        limit = f"did not end within {DEVICE_S:g} s"
        results.append(problem("check", limit, "unplug the device, plug it in and try again"))
    except SlipguardError as error:
        results.append(problem_from_error("driver", error, name, "check its section in the configuration"))
    except OSError as error:
        observed = f"{error.filename or section.driver}: {error.strerror or error}"
        results.append(problem("driver", observed, "check that path in the configuration and its permissions"))
    except Exception as error:
        observed = f"driver {section.driver!r} failed: {type(error).__name__}: {error}"
        results.append(problem("driver", " ".join(observed.split()), "report this to the author of the driver"))
    return results


async def _device_checks(
    name: str, device: Any, section: Any, config: Config, samples: DaemonSamples | None
) -> AsyncIterator[CheckResult]:
    """Yield the driver's own checks, then those of the port unless the driver has already found a problem."""
    found: dict[str, CheckStatus] = {}
    if isinstance(device, Diagnosable):
        async for result in device.diagnose(owned=samples is not None):
            found[result.check] = result.status
            yield result
    store = StateDir(config.state.directory)
    if samples is not None:
        finger = through_daemon.check_finger(name, samples, section.settings) if name in FINGERS else None
        for result in finger or through_daemon.check_actuator(name, samples):
            if result.check not in found:
                yield result
    elif CheckStatus.PROBLEM in found.values():
        return
    elif name in FINGERS:
        async for result in sensor.check_sensor(name, device, section.settings, store):
            yield result
    elif name == "gripper":
        async for result in gripper.check_gripper(name, device):
            yield result
    elif not isinstance(device, Diagnosable):
        yield note(
            "arm",
            f"driver {section.driver!r} has no checks of its own, and opening an arm may take control of it",
            "`slipguard run` shows whether it responds",
        )
