"""Reload the configuration while the service runs: the new one takes effect as a whole or not at all.

The guard's limits and thresholds, the recordings and the log's level take effect at once. Drivers and sensors,
perception, the loop, the API and the state directory are set up at the start and need a restart. While the jaws or the
arm move, nothing of the guard changes. The force on a held object never exceeds its new limit.
"""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import structlog

from slipguard.config import Config, file_content
from slipguard.control.state import Phase
from slipguard.daemon import log_setup
from slipguard.daemon.lifecycle import notify_systemd
from slipguard.daemon.loop.service import Service
from slipguard.errors import SlipguardError

AT_REST = frozenset({Phase.IDLE, Phase.HOLDING, Phase.FAULT})
"""Phases in which neither the jaws nor the arm move."""
RELOADABLE = ("guard.", "recording.", "log.")
NEEDS_RESTART = frozenset({"guard.mode", "recording.directory"})
log = structlog.get_logger()


@dataclass(frozen=True, slots=True)
class ConfigChange:
    """One key and its values, in the types of JSON."""

    key: str
    old: object
    new: object

    def __str__(self) -> str:
        return f"{self.key}: {json.dumps(self.old)} -> {json.dumps(self.new)}"


@dataclass(frozen=True, slots=True)
class CurrentGrip:
    """The grip at the moment of a change. force_n: per finger, commanded or measured; 0 if nothing is held."""

    phase: Phase
    slipping: bool
    force_n: float


def find_changes(old: Config, new: Config) -> list[ConfigChange]:
    """Return every key whose value differs, spelled as in the file; a missing value is None."""
    before, after = dict(_leaves(file_content(old), "")), dict(_leaves(file_content(new), ""))
    keys = [*before, *(key for key in after if key not in before)]
    return [ConfigChange(key, before.get(key), after.get(key)) for key in keys if before.get(key) != after.get(key)]


def _leaves(table: Mapping[str, Any], path: str) -> Iterator[tuple[str, object]]:
    for key, value in table.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, f"{path}{key}.")
        else:
            yield f"{path}{key}", value


def refusal_reason(change: ConfigChange, new: Config, grip: CurrentGrip) -> str | None:
    """Return why a change cannot take effect now; None if it can."""
    if change.key in NEEDS_RESTART or not change.key.startswith(RELOADABLE):
        return "needs a restart"
    if not change.key.startswith("guard."):
        return None
    if grip.phase not in AT_REST:
        return f"not possible while {grip.phase.value}"
    if grip.slipping:
        return "not possible while the object slips"
    if change.key == "guard.force_max_n" and new.guard.force_max_n < grip.force_n:
        return f"the object is held with {grip.force_n:.0f} N; support it, then release it"
    return None


def current_grip(service: Service) -> CurrentGrip:
    """Return how the service holds now."""
    state, gripper = service.state, service.gripper.newest
    measured_n = gripper.force_n if gripper is not None and gripper.holding else 0.0
    return CurrentGrip(state.phase, state.held.slip is not None, max(state.grip.target_n, measured_n))


class Reloader:
    """Applies a new configuration, or refuses it with one log line.

    Args:
        read: Returns the new configuration; called in a thread; raises SlipguardError.
        on_change: Called after each applied change.
    """

    def __init__(self, service: Service, read: Callable[[], Config], on_change: Callable[[], None]) -> None:
        self._service, self._read, self._on_change = service, read, on_change

    async def reload(self) -> bool:
        """Return whether the file's configuration is now in use."""
        notify_systemd(f"RELOADING=1\nMONOTONIC_USEC={time.monotonic_ns() // 1000}")
        try:
            new = await asyncio.to_thread(self._read)
            return self._apply(new)
        except SlipguardError as error:
            self._refuse(str(error))
            return False
        except Exception as error:  # a driver's own check may fail in any way, and the guard must go on
            log.exception("reading the configuration failed")
            self._refuse(f"reading it failed ({type(error).__name__})")
            return False
        finally:
            notify_systemd(f"READY=1\nSTATUS={self._service.phase.value}")

    def _apply(self, new: Config) -> bool:
        """Apply without a pause, so that no cycle of the loop uses half of it."""
        service = self._service
        changes = find_changes(service.config, new)
        grip = current_grip(service)
        refused = [f"{one} {reason}" for one in changes if (reason := refusal_reason(one, new, grip)) is not None]
        if refused:
            self._refuse("; ".join(refused))
            return False
        service.config_problem = None
        if not changes:
            service.event_log.info("configuration reloaded: no changes")
            return True
        service.apply_config(new)
        log_setup.set_level(new.log.level)
        service.event_log.info(f"configuration reloaded: {', '.join(str(change) for change in changes)}")
        self._on_change()
        return True

    def _refuse(self, reason: str) -> None:
        self._service.event_log.warning(f"configuration not reloaded, the old one stays in use: {reason}")
