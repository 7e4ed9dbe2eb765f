"""What goes into the law and what comes out of it, once a tick."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from typing import Literal

from slipguard.control.fault import Fault
from slipguard.control.finger_fusion import FusedEstimate
from slipguard.devices import ArmState, GripperState


class Condition(StrEnum):
    """How a finger's frames are coming."""

    FRESH = "fresh"
    STALE = "stale"
    """None lately, or frozen or corrupt ones; the sensor is there."""
    LOST = "lost"
    """The sensor is gone."""


@dataclass(frozen=True, slots=True)
class FingerHealth:
    """One finger's frames. age_s: since the last good one was captured. why: in a few words, where not fresh."""

    condition: Condition = Condition.FRESH
    age_s: float = 0.0
    why: str = ""


class RequestKind(StrEnum):
    """What a person or another program may ask for."""

    NONE = "none"
    GRASP = "grasp"
    LIFT = "lift"
    LOWER = "lower"
    GUARD_ON = "guard on"
    GUARD_OFF = "guard off"
    GRIPPER = "gripper"
    RELEASE = "release"
    CLEAR = "clear"


@dataclass(frozen=True, slots=True)
class ControlRequest:
    """One wish, handed in for one tick. What is None comes from the configuration.

    grasp: force_n. lift, lower: height_mm (above 0), speed_mm_s. gripper: width_mm, force_n. release: width_mm.
    """

    kind: RequestKind = RequestKind.NONE
    force_n: float | None = None
    height_mm: float | None = None
    speed_mm_s: float | None = None
    width_mm: float | None = None


NO_REQUEST = ControlRequest()
_FIGURES = str.maketrans("", "", "0123456789.+-")


@dataclass(frozen=True, slots=True)
class Observation:
    """All the law knows at one tick. now_s and every time in it: the same monotonic clock.

    fused: of the fingers whose frames are fresh; None if neither has said anything.
    gripper, arm: the newest state; None where the device is gone.
    gripper_limits_n: weakest and strongest grip of this gripper, per finger.
    fault: what the supervisor finds wrong now, the gravest; also: what else it finds.
    """

    now_s: float
    fused: FusedEstimate | None = None
    left: FingerHealth = FingerHealth()
    right: FingerHealth = FingerHealth()
    gripper: GripperState | None = None
    arm: ArmState | None = None
    request: ControlRequest = NO_REQUEST
    gripper_limits_n: tuple[float, float] = (20.0, 235.0)
    fault: Fault | None = None
    also: tuple[Fault, ...] = ()


@dataclass(frozen=True, slots=True)
class ArmLift:
    """Move the arm by height_mm (down when negative) at speed_mm_s."""

    height_mm: float
    speed_mm_s: float


@dataclass(frozen=True, slots=True)
class Command:
    """What the devices should do now; None: nothing new.

    hold_force_n: `Gripper.hold`. halt: `Gripper.halt`. move_width_mm with move_force_n: `Gripper.move`.
    release_width_mm: `Gripper.release`. arm: `Arm.stop` or `Arm.lift`. new_reference: both fingers take a new
    reference from the next stable contact on.
    say: one line for log and page. warn: it tells of trouble; no part of what is commanded.
    refused: why this tick's request was not granted.
    fault: latched now or before.
    """

    hold_force_n: float | None = None
    halt: bool = False
    move_width_mm: float | None = None
    move_force_n: float | None = None
    release_width_mm: float | None = None
    arm: Literal["stop"] | ArmLift | None = None
    new_reference: bool = False
    say: str | None = None
    warn: bool = field(default=False, compare=False)
    refused: str | None = None
    fault: Fault | None = None


def without_figures(text: str) -> str:
    """What is left of a line whose figures change all the time: the same for the same thing."""
    return text.translate(_FIGURES)


def in_one_line(*said: str | None) -> str | None:
    """Several things to say as one; None where there are none."""
    return "; ".join(part for part in said if part is not None) or None
