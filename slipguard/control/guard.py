"""Supervisor and law together: the one call the daemon makes each tick."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from slipguard.control.controller import step
from slipguard.control.messages import Command, Seen
from slipguard.control.params import GuardParams
from slipguard.control.state import GuardState
from slipguard.control.supervisor import Watch, watch


@dataclass(frozen=True, slots=True)
class Guard:
    """The memory of both; a new one adopts whatever the gripper turns out to hold."""

    law: GuardState = field(default_factory=GuardState)
    watch: Watch = field(default_factory=Watch)


def tick(guard: Guard, seen: Seen, params: GuardParams) -> tuple[Guard, Command]:
    """Look for faults first, then let the law decide. Pure; `seen.fault` and `seen.also` need not be filled in."""
    memory, faults = watch(guard.watch, guard.law, seen, params)
    if faults:
        seen = replace(seen, fault=faults[0], also=faults[1:])
    law, command = step(guard.law, seen, params)
    return Guard(law, memory), command
