"""The configuration read again while the service runs: all of the new one, or all of the old one, and why.

What takes effect at once is the guard's limits and thresholds, the recordings and the log's level. Drivers and
sensors, how to see, the loop, the API and the state directory are built at the start and need a restart. While the
jaws or the arm move nothing of the guard changes, and the force that holds an object never exceeds its new budget.
"""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import structlog

from slipguard.config import GROUP_OF, Config
from slipguard.control.state import Phase
from slipguard.daemon import logging as logs
from slipguard.daemon.lifecycle import notify_systemd
from slipguard.daemon.loop.service import Service
from slipguard.errors import SlipguardError

AT_REST = frozenset({Phase.IDLE, Phase.HOLDING, Phase.FAULT})
"""Phases in which neither the jaws nor the arm are on their way."""
AT_ONCE = ("guard.", "recording.", "log.")
RESTART = frozenset({"guard.mode", "recording.directory"})
log = structlog.get_logger()


@dataclass(frozen=True, slots=True)
class Change:
    """One key and its values, as JSON knows them."""

    key: str
    old: object
    new: object

    def __str__(self) -> str:
        return f"{self.key}: {json.dumps(self.old)} -> {json.dumps(self.new)}"


@dataclass(frozen=True, slots=True)
class Grip:
    """What is held at the moment of a change. force_n: per finger, commanded or measured; 0 where nothing is."""

    phase: Phase
    slipping: bool
    force_n: float


def changes(old: Config, new: Config) -> list[Change]:
    """Every key whose value differs, as the file spells it; `null` where it is not given."""
    before, after = dict(_flat(old)), dict(_flat(new))
    keys = [*before, *(key for key in after if key not in before)]
    return [Change(key, before.get(key), after.get(key)) for key in keys if before.get(key) != after.get(key)]


def _flat(config: Config) -> Iterator[tuple[str, object]]:
    whole = config.model_dump(mode="json", serialize_as_any=True)
    for name in GROUP_OF:
        section = whole[name]
        section[section["driver"]] = section.pop("settings")
    yield from _leaves(whole, "")


def _leaves(table: Mapping[str, Any], path: str) -> Iterator[tuple[str, object]]:
    for key, value in table.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, f"{path}{key}.")
        else:
            yield f"{path}{key}", value


def why_not(change: Change, new: Config, grip: Grip) -> str | None:
    """Why a change cannot take effect now; None if it can."""
    if change.key in RESTART or not change.key.startswith(AT_ONCE):
        return "needs a restart"
    if not change.key.startswith("guard."):
        return None
    if grip.phase not in AT_REST:
        return f"not while {grip.phase.value}"
    if grip.slipping:
        return "not while the object slips"
    if change.key == "guard.force_max_n" and new.guard.force_max_n < grip.force_n:
        return f"the object is held with {grip.force_n:.0f} N; release it first"
    return None


def grip_of(service: Service) -> Grip:
    """How the service holds now."""
    state, gripper = service.state, service.gripper.newest
    measured_n = gripper.force_n if gripper is not None and gripper.holding else 0.0
    return Grip(state.phase, state.slip is not None, max(state.target_n, measured_n))


class Reloader:
    """Takes up a new configuration, or refuses it in one line.

    read: gives the new one, in a thread; raises SlipguardError. on_change: called after each that was taken up.
    """

    def __init__(self, service: Service, read: Callable[[], Config], on_change: Callable[[], None]) -> None:
        self._service, self._read, self._on_change = service, read, on_change

    async def reload(self) -> bool:
        """Whether the file's configuration is now the one in use."""
        notify_systemd(f"RELOADING=1\nMONOTONIC_USEC={time.monotonic_ns() // 1000}")
        try:
            new = await asyncio.to_thread(self._read)
            return self._take_up(new)
        except SlipguardError as error:
            self._refuse(str(error))
            return False
        except Exception as error:  # a driver's own check may fail in any way, and the guard must not end with it
            log.exception("configuration not read")
            self._refuse(f"reading it failed ({type(error).__name__})")
            return False
        finally:
            notify_systemd(f"READY=1\nSTATUS={self._service.phase.value}")

    def _take_up(self, new: Config) -> bool:
        """Without a pause, so that no turn of the loop sees half of it."""
        service = self._service
        changed = changes(service.config, new)
        grip = grip_of(service)
        refused = [f"{change} {why}" for change in changed if (why := why_not(change, new, grip)) is not None]
        if refused:
            self._refuse("; ".join(refused))
            return False
        if not changed:
            service.event_log.info("configuration read again: nothing has changed")
            return True
        service.config = new
        logs.set_level(new.log.level)
        service.event_log.info(f"configuration read again: {', '.join(str(change) for change in changed)}")
        self._on_change()
        return True

    def _refuse(self, why: str) -> None:
        self._service.event_log.warning(f"configuration not taken up, the old one stays in full: {why}")
