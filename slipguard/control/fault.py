"""What can go wrong while something is held, each with what was seen and what a person should do."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class FaultCode(StrEnum):
    """Names for the log, the API and the page."""

    FRAMES_LOST = "frames lost"
    ESTIMATE_UNTRUSTED = "estimate untrusted"
    GRIPPER_SILENT = "gripper silent"
    GRIPPER_FAULT = "gripper fault"
    GRIPPER_STUCK = "gripper stuck"
    ARM_SILENT = "arm silent"
    ARM_STOPPED = "arm in protective stop"
    ARM_EMERGENCY = "arm in emergency stop"
    ARM_STUCK = "arm stuck"
    LOOP_LATE = "loop late"
    NO_HELP = "tightening does not help"
    BUDGET_SPENT = "force budget spent"
    TURNED_TOO_FAR = "turned too far"
    OBJECT_LOST = "object lost"


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault. observed: what was measured, with values and limits. what_to_do: one sentence for the person at the cell."""

    code: FaultCode
    observed: str
    what_to_do: str

    def __str__(self) -> str:
        return f"{self.code}: {self.observed}; {self.what_to_do}"
