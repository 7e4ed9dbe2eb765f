"""Build the controller's nested records from flat names, so that a test states only what matters to it."""

from __future__ import annotations

from dataclasses import fields, is_dataclass, replace
from typing import Any, TypeVar

from slipguard.control.load_state import LoadState
from slipguard.control.messages import HaltJaws, MoveJaws, ReleaseJaws, StepOutput
from slipguard.control.state import GraspState, Phase

T = TypeVar("T")
ALIASES = {
    "arm_commanded_s": ("arm", "commanded_s"),
    "arm_speed_mm_s": ("arm", "speed_mm_s"),
    "person_near": ("person", "now"),
    "adopted": ("adoption", "done"),
    "known_faults": ("reported", "faults"),
}
"""Flat names that differ from the field's name, or that two records share."""


def changed(record: T, **changes: Any) -> T:
    """Return the record with some fields changed: its own, or those of the records in it."""
    own = {one.name for one in fields(record)}  # type: ignore[arg-type]
    inner: dict[str, dict[str, Any]] = {}
    for name in [name for name in changes if name not in own]:
        field, leaf = ALIASES.get(name) or (_owner(record, name), name)
        inner.setdefault(field, {})[leaf] = changes.pop(name)
    for name, values in inner.items():
        changes[name] = replace(changes.get(name, getattr(record, name)), **values)
    return replace(record, **changes)  # type: ignore[type-var]


def _owner(record: Any, leaf: str) -> str:
    for one in fields(record):
        value = getattr(record, one.name)
        if is_dataclass(value) and leaf in {inner.name for inner in fields(value)}:
            return one.name
    raise AttributeError(f"no field {leaf} in {type(record).__name__}")


def grasp_state(phase: Phase = Phase.IDLE, **values: Any) -> GraspState:
    """Return a state with these fields; everything else is as at the start."""
    return changed(GraspState(phase), **values)


def load_state(**values: Any) -> LoadState:
    """Return the load of a held object with these fields; everything else is as at the start."""
    return changed(LoadState(), **values)


def released_mm(output: StepOutput) -> float | None:
    """Return the width of a release commanded in this step."""
    return output.gripper.width_mm if isinstance(output.gripper, ReleaseJaws) else None


def moved_mm(output: StepOutput) -> float | None:
    """Return the width of a motion of the jaws commanded in this step."""
    return output.gripper.width_mm if isinstance(output.gripper, MoveJaws) else None


def halted(output: StepOutput) -> bool:
    """Return whether the jaws are halted in this step."""
    return isinstance(output.gripper, HaltJaws)
