"""Inputs and outputs of one control step: the observation, the request in it, and the commands that follow."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Annotated, Literal

from pydantic import Field

from slipguard.control.finger_fusion import FusedEstimate
from slipguard.control.reports import Fault, Message
from slipguard.devices import ArmState, GripperState


class Condition(StrEnum):
    """Whether a finger sees, or why not."""

    FRESH = "fresh"
    STALE = "stale"
    """No recent frame, or only frozen or corrupt ones; the sensor is connected."""
    LATE = "late"
    """Frames arrive, but are received or processed too late."""
    STUCK = "stuck"
    """Frames arrive, but the processing of one does not return, and its thread did not wait for a processor."""
    LOST = "lost"
    """The sensor is not connected."""
    BLIND = "blind"
    """Frames arrive, but do not show the gel: light, focus, format."""


@dataclass(frozen=True, slots=True)
class FingerHealth:
    """One finger's frames. age_s: since the last good one was captured. why: the reason if they are not fresh."""

    condition: Condition = Condition.FRESH
    age_s: float = 0.0
    why: str = ""


class RequestKind(StrEnum):
    """What a person or another program may request."""

    NONE = "none"
    GRASP = "grasp"
    LIFT = "lift"
    LOWER = "lower"
    GUARD_ON = "guard on"
    GUARD_OFF = "guard off"
    GRIPPER = "gripper"
    RELEASE = "release"
    STOP = "stop"
    CLEAR = "clear"
    ACTIVATE = "activate"


@dataclass(frozen=True, slots=True)
class ControlRequest:
    """One request, handled in one control step. A value that is None comes from the configuration.

    grasp: force_n, force_limit_n (of this object alone). lift, lower: height_mm (above 0), speed_mm_s. gripper:
    width_mm, force_n. release: width_mm.
    """

    kind: RequestKind = RequestKind.NONE
    force_n: float | None = None
    height_mm: float | None = None
    speed_mm_s: float | None = None
    width_mm: float | None = None
    force_limit_n: float | None = None


NO_REQUEST = ControlRequest()
_FIGURES = str.maketrans("", "", "0123456789.+-")


@dataclass(frozen=True, slots=True)
class Observation:
    """Everything the controller knows in one step. now_s and every time in it: the same monotonic clock.

    Args:
        fused: estimate from the fingers whose frames are fresh; None if there is none.
        gripper, arm: the newest state; None if the device is not connected.
        busy_s: for how much of the last second the loop was late.
        gripper_limits_n: weakest and strongest grip of this gripper, newtons per finger.
        fault: the gravest fault the supervisor finds now; other_faults: what else it finds.
    """

    now_s: float
    fused: FusedEstimate | None = None
    left: FingerHealth = FingerHealth()
    right: FingerHealth = FingerHealth()
    gripper: GripperState | None = None
    arm: ArmState | None = None
    request: ControlRequest = NO_REQUEST
    busy_s: float = 0.0
    gripper_limits_n: tuple[float, float] = (20.0, 235.0)
    fault: Fault | None = None
    other_faults: tuple[Fault, ...] = ()

    @property
    def faults(self) -> tuple[Fault, ...]:
        """All faults the supervisor finds now, the gravest first."""
        return () if self.fault is None else (self.fault, *self.other_faults)

    def with_fault(self, fault: Fault) -> Observation:
        """Return the same observation with one more fault, the least grave one."""
        if self.fault is None:
            return replace(self, fault=fault)
        return replace(self, other_faults=(*self.other_faults, fault))

    @property
    def rotation_deg(self) -> float:
        """Rotation since the reference, without sign; 0 if there is no estimate."""
        rotation_deg = self.fused.rotation_deg if self.fused is not None else None
        return 0.0 if rotation_deg is None else abs(rotation_deg)


@dataclass(frozen=True, slots=True)
class HoldForce:
    """`Gripper.hold`: grip with this force, newtons per finger."""

    force_n: float
    kind: Literal["hold"] = "hold"


@dataclass(frozen=True, slots=True)
class MoveJaws:
    """`Gripper.move`: move the jaws to a width, with at most this force."""

    width_mm: float
    force_n: float
    kind: Literal["move"] = "move"


@dataclass(frozen=True, slots=True)
class HaltJaws:
    """`Gripper.halt`: stop the jaws where they are."""

    kind: Literal["halt"] = "halt"


@dataclass(frozen=True, slots=True)
class ReleaseJaws:
    """`Gripper.release`: open the jaws to a width."""

    width_mm: float
    kind: Literal["release"] = "release"


@dataclass(frozen=True, slots=True)
class ActivateGripper:
    """`Gripper.activate`: the empty jaws open and close fully."""

    kind: Literal["activate"] = "activate"


@dataclass(frozen=True, slots=True)
class StopArm:
    """`Arm.stop`."""

    kind: Literal["stop"] = "stop"


@dataclass(frozen=True, slots=True)
class LiftArm:
    """`Arm.lift`: move the arm by height_mm (down if negative) at speed_mm_s."""

    height_mm: float
    speed_mm_s: float
    kind: Literal["lift"] = "lift"


GripperCommand = Annotated[HoldForce | MoveJaws | HaltJaws | ReleaseJaws | ActivateGripper, Field(discriminator="kind")]
ArmCommand = Annotated[StopArm | LiftArm, Field(discriminator="kind")]


@dataclass(frozen=True, slots=True)
class StepOutput:
    """What follows from one control step.

    Args:
        gripper, arm: the new command to each device; None: none.
        new_reference: both fingers take a new reference from the next stable contact on.
        messages: what log and page show. is_warning: they report trouble; not compared.
        refusal: why this step's request was refused.
        fault: the latched fault.
    """

    gripper: GripperCommand | None = None
    arm: ArmCommand | None = None
    new_reference: bool = False
    messages: tuple[Message, ...] = ()
    is_warning: bool = field(default=False, compare=False)
    refusal: Message | None = None
    fault: Fault | None = None

    @property
    def hold_force_n(self) -> float | None:
        """The force of a hold commanded in this step; None if there is none."""
        return self.gripper.force_n if isinstance(self.gripper, HoldForce) else None

    @property
    def text(self) -> str | None:
        """All messages as one line; None if there are none."""
        return "; ".join(message.text for message in self.messages) or None

    def with_messages(self, *messages: Message | None) -> StepOutput:
        """Return the same output with more messages; None stands for no message."""
        return replace(self, messages=(*self.messages, *(message for message in messages if message is not None)))


def without_figures(text: str) -> str:
    """Return a text without its figures: equal for two messages that differ in values only."""
    return text.translate(_FIGURES)
