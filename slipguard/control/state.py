"""What the law remembers from tick to tick."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from enum import StrEnum

from slipguard.control.fault import Fault, FaultCode
from slipguard.control.gripper_delay import GripperDelay
from slipguard.control.slip_baselines import SlipMemory
from slipguard.devices import GripperState


class Phase(StrEnum):
    """Where a grasp is."""

    IDLE = "idle"
    CLOSING = "closing"
    REFERENCE = "reference"
    """Held; the fingers take their reference."""
    LIFTING = "lifting"
    HOLDING = "holding"
    """Held and guarded, on the table or in the air."""
    LOWERING = "lowering"
    RELEASED = "released"
    """Opening, on request."""
    FAULT = "fault"
    """The arm is stopped and the grip kept, until a person clears it or releases."""


AT_STAKE = frozenset({Phase.CLOSING, Phase.REFERENCE, Phase.LIFTING, Phase.HOLDING, Phase.LOWERING})
"""Phases in which something is, or is about to be, between the fingers: faults latch."""
MOVING = frozenset({Phase.LIFTING, Phase.LOWERING})
"""Phases in which slipguard moves the arm."""


@dataclass(frozen=True, slots=True)
class SlipEpisode:
    """One episode of slip, from the trigger until all is calm. turn, rate and slide: when it was last tightened.

    turns, slides: which of the two it was, or both. raised: the force was raised.
    """

    began_s: float
    stepped_s: float
    rotation_deg: float
    rate_deg_s: float
    slip_mm: float
    rotations: bool = False
    slides: bool = False
    raised: bool = False


@dataclass(frozen=True, slots=True)
class RememberedGrip:
    """How an object was held before a restart: the force per finger last commanded, and the jaws' width then.

    applied: the gripper had applied that force, and said so; else nobody knows whether it was told in time.
    """

    force_n: float
    width_mm: float
    applied: bool = True


FORCE_TOLERANCE_N = 0.5
SAME_WIDTH_MM = 1.0
"""Jaws within this of where they were still hold the same thing: a self-locking gripper does not creep."""


@dataclass(frozen=True, slots=True)
class GraspState:
    """The law's whole memory.

    since_s: when the phase began. guarding: slip is acted on (`guard off` ends that until `guard on`).
    target_n: the force per finger last commanded or adopted; 0 with nothing held. commanded_s: when.
    ground_mm, goal_mm: arm heights where the lift began and where the present motion ends.
    arm_sent_s: when the arm was last told something. paused: the arm waits for calm.
    putting_down: in FAULT, the arm goes back to where the lift began.
    gripped: the jaws have met something since they closed.
    referenced: the turn could be read when the object was gripped. blind: why it could not.
    person_near: the arm was last seen in a protective or emergency stop, so no force is added.
    halted_s: when the jaws were last halted for that; -inf: not in this stop.
    closing_interrupted: they were halted before they had met something, so the grasp must be asked for again.
    release_requested: a release was asked for. braking: the arm has not said since then that it stands.
    adopted: the gripper's first state has been looked at. found: it was seen to hold something already.
    remembered: the grip before a restart, until the gripper's first state has been looked at.
    note: what was last said against a finger's turn. noted_s: when it was last so.
    besides: what is wrong and has been said while a fault is latched.
    """

    phase: Phase = Phase.IDLE
    since_s: float = 0.0
    guarding: bool = True
    target_n: float = 0.0
    commanded_s: float = -math.inf
    delay: GripperDelay = field(default_factory=GripperDelay)
    detector: SlipMemory = field(default_factory=SlipMemory)
    slip: SlipEpisode | None = None
    ground_mm: float | None = None
    goal_mm: float | None = None
    lift_speed_mm_s: float | None = None
    arm_sent_s: float = -math.inf
    paused: bool = False
    putting_down: bool = False
    gripped: bool = False
    referenced: bool = False
    blind: str | None = None
    person_near: bool = False
    halted_s: float = -math.inf
    closing_interrupted: bool = False
    release_requested: bool = False
    braking: bool = False
    lost_since_s: float | None = None
    adopted: bool = False
    found: bool = False
    remembered: RememberedGrip | None = None
    note: str | None = None
    noted_s: float = -math.inf
    besides: frozenset[FaultCode] = frozenset()
    fault: Fault | None = None

    @property
    def hands_off(self) -> bool:
        """What may be between the jaws is not to be tightened or guarded until a person says so."""
        return self.release_requested or self.closing_interrupted


def gripper_at_rest(state: GraspState, gripper: GripperState) -> bool:
    """The gripper is at rest, and said so after it was last told something."""
    return not gripper.moving and gripper.measured_at_s > state.commanded_s


def force_applied(state: GraspState, gripper: GripperState) -> bool:
    """The gripper applies the force it was last told, as it said at rest; one taken over was told nothing."""
    if state.commanded_s == -math.inf:
        return True
    return gripper_at_rest(state, gripper) and gripper.force_n >= state.target_n - FORCE_TOLERANCE_N


def waiting(state: GraspState) -> bool:
    """Something was held before a restart, or a fault latched, and nobody has seen yet what the gripper holds now."""
    if state.phase is Phase.IDLE:
        return not state.adopted and state.remembered is not None
    return not state.adopted and state.phase is Phase.FAULT


def as_wide(before: RememberedGrip, gripper: GripperState) -> bool:
    """The jaws still are where they held what is remembered."""
    return abs(before.width_mm - gripper.width_mm) <= SAME_WIDTH_MM


def entered(state: GraspState, phase: Phase, now_s: float) -> GraspState:
    """The same memory at the beginning of another phase."""
    return replace(state, phase=phase, since_s=now_s, paused=False, putting_down=False)


def emptied(state: GraspState, phase: Phase, now_s: float) -> GraspState:
    """Nothing is held any more: everything about the object is forgotten."""
    return GraspState(phase=phase, since_s=now_s, guarding=state.guarding, person_near=state.person_near, adopted=True)


def taken_over(state: GraspState, gripper: GripperState, now_s: float) -> GraspState:
    """The object the gripper holds, with the grip it has, is guarded from a new reference on.

    A gripper that has been asked nothing since its connection was opened knows no force: where the jaws are as wide as
    before the restart, the object is held with the force that it had taken by then.
    """
    force_n, before = gripper.force_n, state.remembered
    if before is not None and before.applied and as_wide(before, gripper):
        force_n = max(force_n, before.force_n)
    return replace(emptied(state, Phase.REFERENCE, now_s), target_n=force_n, gripped=True)
