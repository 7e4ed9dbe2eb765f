"""What the controller remembers from step to step: one record for each concern."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from enum import StrEnum

from slipguard.control.load_state import PAD, LoadState
from slipguard.control.reports import Fault, FaultCode
from slipguard.devices import GripperState
from slipguard.limit_surface import Pad


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
"""Phases in which an object is, or is about to be, between the jaws: faults latch."""
MOVING = frozenset({Phase.LIFTING, Phase.LOWERING})
"""Phases in which slipguard moves the arm."""
FORCE_TOLERANCE_N = 0.5
SAME_WIDTH_MM = 1.0
"""Jaws within this of their former width still hold the same object: a self-locking gripper does not creep."""
MOVED_MM = 0.5
"""A count of a Robotiq's position is 0.37 mm."""
STOP_AND_GO_S = 0.016
"""Tightening takes one transaction more than closing: stop, then go."""


@dataclass(frozen=True, slots=True)
class GripperDelay:
    """Time from a command to its effect, measured while the jaws close.

    Args:
        commanded_s, from_mm: the closing that is being timed.
        delay_s: from a command to its first effect; None: not measured yet.
    """

    commanded_s: float | None = None
    from_mm: float = 0.0
    delay_s: float | None = None

    def measured(self, commanded_s: float, gripper: GripperState | None) -> GripperDelay:
        """Return the delay after one more state of jaws that were commanded to close at `commanded_s`."""
        if gripper is None:
            return self
        if self.commanded_s != commanded_s:
            return replace(self, commanded_s=commanded_s, from_mm=gripper.width_mm)
        if self.from_mm - gripper.width_mm <= MOVED_MM or self.delay_s is not None:
            return self
        return replace(self, delay_s=max(gripper.measured_at_s - commanded_s, 0.0) + STOP_AND_GO_S)


@dataclass(frozen=True, slots=True)
class Grip:
    """The grip.

    Args:
        target_n: force per finger last commanded or taken over; 0 with nothing held.
        commanded_s: when the gripper was last commanded; -inf: not since the grip was taken over, or, in RELEASED,
            the jaws have not been commanded to open yet.
        closed: the jaws have met an object since they closed.
        nothing_since_s: since when the gripper reports that it has closed on nothing; None: it does not.
        delay: of the gripper.
        limit_n: force limit that was requested for this object; None: that of the configuration.
    """

    target_n: float = 0.0
    commanded_s: float = -math.inf
    closed: bool = False
    nothing_since_s: float | None = None
    delay: GripperDelay = field(default_factory=GripperDelay)
    limit_n: float | None = None


@dataclass(frozen=True, slots=True)
class SlipEpisode:
    """One episode of slip, from the first tightening until object and gripper have settled.

    Args:
        began_s, tightened_s: when it began, and when the grip was last tightened.
    """

    began_s: float
    tightened_s: float


@dataclass(frozen=True, slots=True)
class HeldObject:
    """The object between the jaws, as the fingers see it.

    Args:
        referenced: its rotation was estimated when it was gripped; no_estimate: else the reason.
        load: over what the grip holds. slip: the present episode.
        seen_by: fingers that have seen contact in this grip. lost_since_s: since when it seems to be lost.
        pad: with the contact that was seen when it was gripped.
    """

    referenced: bool = False
    no_estimate: str | None = None
    load: LoadState = field(default_factory=LoadState)
    slip: SlipEpisode | None = None
    seen_by: frozenset[str] = frozenset()
    lost_since_s: float | None = None
    pad: Pad = PAD


@dataclass(frozen=True, slots=True)
class ArmMotion:
    """The arm and its motion with the object.

    Args:
        ground_mm: height where the lift began; None: unknown. goal_mm: where the present motion ends.
        start_mm: tool position where the lift began, which a restart does not change; None: unknown.
        speed_mm_s: requested for this motion; None: from the configuration.
        commanded_s: when the arm was last commanded.
        paused: in LIFTING and LOWERING, the arm waits until the object has settled.
        putting_down: in FAULT, the arm goes back down to where the lift began.
    """

    ground_mm: float | None = None
    start_mm: tuple[float, float, float] | None = None
    goal_mm: float | None = None
    speed_mm_s: float | None = None
    commanded_s: float = -math.inf
    paused: bool = False
    putting_down: bool = False


@dataclass(frozen=True, slots=True)
class Release:
    """A release in progress, in RELEASED.

    Args:
        width_mm: requested.
        arm_may_move: the arm has not reported since the request that it stands.
        held: something may have been held when it was requested.
        from_mm: the narrowest width of the jaws since the request. to_mm: the widest since then, reached at widened_s.
        opened_s: since when the gripper reports that they are open and at rest; None: it does not.
    """

    width_mm: float
    arm_may_move: bool = False
    held: bool = True
    from_mm: float = math.inf
    to_mm: float = math.inf
    widened_s: float = -math.inf
    opened_s: float | None = None


@dataclass(frozen=True, slots=True)
class RequestedStop:
    """A stop on request, until the arm's next motion on request.

    Args:
        jaws: they had no grip yet, so they are halted whenever they move, until their next motion on request.
        arm_stood: the arm has stood since.
    """

    jaws: bool = False
    arm_stood: bool = False


@dataclass(frozen=True, slots=True)
class HandsOff:
    """Why the jaws' content is neither guarded nor tightened until a person requests it.

    Args:
        release_requested: it was to be released.
        closing_interrupted: the jaws were halted before they had met it, so it may be a hand.
    """

    release_requested: bool = False
    closing_interrupted: bool = False

    def __bool__(self) -> bool:
        return self.release_requested or self.closing_interrupted


@dataclass(frozen=True, slots=True)
class PersonNear:
    """A person may be near: the arm reports a protective or emergency stop, so no force is added.

    Args:
        now: the arm reports it now.
        halted_s: when the jaws were last halted for it; -inf: not in this stop.
        after_stop: the stop is over, but a fault is latched. A hand may still be there, so no force is added until a
            person requests it.
    """

    now: bool = False
    halted_s: float = -math.inf
    after_stop: bool = False

    @property
    def forbids_force(self) -> bool:
        """No force may be added."""
        return self.now or self.after_stop


@dataclass(frozen=True, slots=True)
class RememberedGrip:
    """How an object was held before a restart: the force per finger last commanded, and the jaws' width then.

    applied: the gripper had confirmed that force; otherwise the command may never have arrived. lift_start_mm: tool
    position where the object's lift began; None: it was not lifted, or the arm reports no position. limit_n: see Grip.
    """

    force_n: float
    width_mm: float
    applied: bool = True
    lift_start_mm: tuple[float, float, float] | None = None
    limit_n: float | None = None

    def fits(self, gripper: GripperState) -> bool:
        """Return whether the jaws still are where they held the object."""
        return abs(self.width_mm - gripper.width_mm) <= SAME_WIDTH_MM


@dataclass(frozen=True, slots=True)
class Adoption:
    """What the gripper held at the start.

    Args:
        done: its first state has been used.
        found: an object was found in it; taking it over waits for a finger.
        remembered: the grip before the restart, until done.
        outdated: a grip from before the restart cannot be used, because the file is too old or damaged, and the gripper
            was not active since.
    """

    done: bool = False
    found: bool = False
    remembered: RememberedGrip | None = None
    outdated: bool = False


@dataclass(frozen=True, slots=True)
class Reported:
    """What has been reported already.

    Args:
        note, noted_s: the last message about a finger's estimate, and when it last applied.
        faults: in FAULT, all that is wrong.
    """

    note: str | None = None
    noted_s: float = -math.inf
    faults: frozenset[FaultCode] = frozenset()


@dataclass(frozen=True, slots=True)
class GraspState:
    """The controller's whole memory.

    Args:
        since_s: when the phase began.
        guarding: slip has an effect (`guard off` ends that until `guard on`).
        release: in RELEASED only.
        fault: in FAULT only: the latched one.
    """

    phase: Phase = Phase.IDLE
    since_s: float = 0.0
    guarding: bool = True
    grip: Grip = field(default_factory=Grip)
    held: HeldObject = field(default_factory=HeldObject)
    arm: ArmMotion = field(default_factory=ArmMotion)
    release: Release | None = None
    stop: RequestedStop | None = None
    hands_off: HandsOff = field(default_factory=HandsOff)
    person: PersonNear = field(default_factory=PersonNear)
    adoption: Adoption = field(default_factory=Adoption)
    reported: Reported = field(default_factory=Reported)
    fault: Fault | None = None

    @property
    def waits_for_gripper(self) -> bool:
        """A fault or a grip is known from before a restart, and the gripper has not reported yet what it holds."""
        if self.phase is Phase.IDLE:
            return not self.adoption.done and self.adoption.remembered is not None
        return not self.adoption.done and self.phase is Phase.FAULT

    @property
    def load_over_capacity(self) -> float | None:
        """The median of the load over what the grip holds; None while nothing is guarded."""
        load = self.held.load
        return load.over_capacity(0.5) if load.weights and self.guarding else None

    def entered(self, phase: Phase, now_s: float) -> GraspState:
        """Return the state at the beginning of another phase."""
        arm = replace(self.arm, paused=False, putting_down=False)
        return replace(self, phase=phase, since_s=now_s, arm=arm, release=None)

    def emptied(self, phase: Phase, now_s: float) -> GraspState:
        """Return the state with nothing held: everything about the object is forgotten."""
        person, adoption = PersonNear(self.person.now), Adoption(done=True)
        return GraspState(phase, now_s, self.guarding, person=person, adoption=adoption)

    def taken_over(self, gripper: GripperState, now_s: float) -> GraspState:
        """Return the state that guards what the gripper holds, with the grip it has, from a new reference on.

        A gripper that has not been commanded since its connection was opened knows no force. If the jaws are as wide
        as before the restart, the object is held with the force confirmed then, and its lift began where it did.
        """
        force_n, before, limit_n = gripper.force_n, self.adoption.remembered, self.grip.limit_n
        same = before is not None and before.fits(gripper)
        if before is not None and same and before.applied:
            force_n = max(force_n, before.force_n)
        if before is not None and same:
            limit_n = before.limit_n
        arm = ArmMotion(start_mm=before.lift_start_mm) if before is not None and same else ArmMotion()
        return replace(self.emptied(Phase.REFERENCE, now_s), grip=Grip(force_n, closed=True, limit_n=limit_n), arm=arm)

    def with_jaws_requested(self) -> GraspState:
        """Return the state after a person or another program has requested what the jaws do."""
        stop = None if self.stop is None else replace(self.stop, jaws=False)
        return replace(self, stop=stop, hands_off=HandsOff())

    def with_target(self, force_n: float, now_s: float) -> GraspState:
        """Return the state after this force was commanded."""
        return replace(self, grip=replace(self.grip, target_n=force_n, commanded_s=now_s))


def force_text(gripper: GripperState | None, target_n: float) -> str:
    """Return the force that holds the object, as text. target_n: last commanded."""
    if gripper is None or gripper.force_known or target_n > gripper.force_n:
        return f"{target_n:.0f} N"
    return f"an unknown force of at least {gripper.force_n:.0f} N"


def gripper_at_rest(state: GraspState, gripper: GripperState) -> bool:
    """Return whether the gripper has reported since the last command that it is at rest."""
    return not gripper.moving and gripper.measured_at_s > state.grip.commanded_s


def force_applied(state: GraspState, gripper: GripperState) -> bool:
    """Return whether the gripper has confirmed the commanded force; a grip that was taken over counts as confirmed."""
    if state.grip.commanded_s == -math.inf:
        return True
    return gripper_at_rest(state, gripper) and gripper.force_n >= state.grip.target_n - FORCE_TOLERANCE_N
