"""Whether the held object is still there: one table of what the gripper says and what each finger can say.

A finger that cannot see says nothing, and no finger is believed that has not seen contact in this grip: its light, its
background image or its frames' delay may be wrong. So an object counts as lost if the gripper says so, or if contact
was seen to end in good light.
"""

from __future__ import annotations

from dataclasses import replace
from enum import Enum, StrEnum

from slipguard.control.messages import Observation
from slipguard.control.params import GuardParams
from slipguard.control.reports import Fault, FaultCode, Message, Text
from slipguard.control.state import AT_STAKE, GraspState, Phase
from slipguard.devices import FINGERS

LOST_ALONE_TIMES = 3.0
"""A loss that one finger alone reports, and the gripper does not, must last this many times `lost_after_s`."""
LATE_S = 0.25
"""Contact is seen before the gripper reports a grip: 0.06 to 0.1 s in 72 rendered ones. If it is seen this much later,
the images are old, also if their stamps are new."""
LOOK = "look for the object; if the jaws still touch it, support it, then release; otherwise clear"
SUPPORT = "the gripper may still hold the object: support it by hand, check the jaws, then clear"
CHECK_IMAGES = (
    "the grip is kept; check light, lens and cable of both sensors, then clear; until then slip is not detected"
)


class Jaws(StrEnum):
    """What the gripper says about what is between the jaws."""

    HOLD = "hold"
    """They hold, or the gripper does not report."""
    MOVE = "move"
    """They no longer hold, and move."""
    EMPTY = "empty"
    """They closed on nothing, or rest without an object."""


class Sight(StrEnum):
    """What a finger can say about contact."""

    CONTACT = "contact"
    ENDED = "ended"
    """No contact, after contact was seen in this grip."""
    NOT_YET = "not yet"
    """No contact, and none was seen in this grip."""
    NONE = "none"
    """It cannot see: no fresh frame, or one that does not show the gel."""


class Presence(Enum):
    """What follows for the object."""

    THERE = "there"
    LOST = "lost"
    LOST_TO_ONE = "lost to one finger"
    UNSEEN = "unseen"
    """It is held, and no finger has seen it."""
    BLIND = "blind"
    """No finger can see. The supervisor reports why."""


_C, _E, _N, _X = Sight.CONTACT, Sight.ENDED, Sight.NOT_YET, Sight.NONE
TABLE: dict[frozenset[Sight], dict[Jaws, Presence]] = {
    frozenset(fingers): {Jaws.HOLD: hold, Jaws.MOVE: move, Jaws.EMPTY: Presence.LOST}
    for fingers, hold, move in (
        ((_C, _C), Presence.THERE, Presence.THERE),
        ((_C, _E), Presence.THERE, Presence.THERE),
        ((_C, _N), Presence.THERE, Presence.THERE),
        ((_C, _X), Presence.THERE, Presence.THERE),
        ((_E, _E), Presence.LOST, Presence.LOST),
        ((_E, _N), Presence.LOST_TO_ONE, Presence.LOST),
        ((_E, _X), Presence.LOST_TO_ONE, Presence.LOST),
        ((_N, _N), Presence.UNSEEN, Presence.UNSEEN),
        ((_N, _X), Presence.UNSEEN, Presence.UNSEEN),
        ((_X, _X), Presence.BLIND, Presence.BLIND),
    )
}
"""What follows from the sight of both fingers, in either order, by what the gripper says."""


def jaws(observation: Observation) -> Jaws:
    """Return what the gripper says."""
    gripper = observation.gripper
    if gripper is None:
        return Jaws.HOLD
    if gripper.closed_on_nothing or not (gripper.holding or gripper.moving):
        return Jaws.EMPTY
    return Jaws.HOLD if gripper.holding else Jaws.MOVE


def sights(state: GraspState, observation: Observation) -> tuple[Sight, Sight]:
    """Return what the left and the right finger can say."""
    fused = observation.fused
    if fused is None:
        return Sight.NONE, Sight.NONE
    left, right = (
        Sight.NONE if touches is None else Sight.CONTACT if touches else Sight.ENDED if seen else Sight.NOT_YET
        for touches, seen in (
            (fused.left_contact, "left" in state.held.seen_by),
            (fused.right_contact, "right" in state.held.seen_by),
        )
    )
    return left, right


def late_contact(before: GraspState, now: GraspState, observation: Observation) -> Message | None:
    """Return that a finger has seen the contact late after the grip, in the step in which it does."""
    fused = observation.fused
    if now.phase is not Phase.REFERENCE or fused is None or fused.captured_at_s - now.since_s < LATE_S:
        return None
    new = [name for name in FINGERS if name in now.held.seen_by - before.held.seen_by]
    late_s = fused.captured_at_s - now.since_s
    return Text.CONTACT_LATE.message(fingers=" and ".join(new), late_s=late_s) if new else None


def watch_object(state: GraspState, observation: Observation, params: GuardParams) -> tuple[GraspState, Fault | None]:
    """Return the state, and the fault of an object that is lost or that no finger has seen."""
    now_s, held, tuning = observation.now_s, state.held, params.tuning
    fingers = sights(state, observation)
    gripped = state.phase in AT_STAKE - {Phase.CLOSING} or (state.phase is Phase.FAULT and state.grip.closed)
    if gripped or state.phase is Phase.CLOSING:
        seen = {name for name, sight in zip(FINGERS, fingers, strict=True) if sight is Sight.CONTACT}
        held = replace(held, seen_by=held.seen_by | seen)
    gripper = jaws(observation)
    presence = TABLE[frozenset(fingers)][gripper] if gripped else Presence.THERE
    if presence in (Presence.THERE, Presence.BLIND):
        return replace(state, held=replace(held, lost_since_s=None)), None
    since_s = now_s if held.lost_since_s is None else held.lost_since_s
    state = replace(state, held=replace(held, lost_since_s=since_s))
    times = LOST_ALONE_TIMES if presence is Presence.LOST_TO_ONE else 1.0
    limit_s = tuning.reference_timeout_s if presence is Presence.UNSEEN else times * tuning.lost_after_s
    if now_s - since_s < limit_s:
        return state, None
    if presence is Presence.UNSEEN:
        unseen = f"an object is gripped, and no finger has seen contact for {now_s - since_s:.1f} s"
        return state, Fault(FaultCode.FINGERS_BLIND, unseen, CHECK_IMAGES)
    if gripper is not Jaws.EMPTY:
        return state, Fault(FaultCode.OBJECT_LOST, "contact has ended, in good light", SUPPORT)
    nothing = observation.gripper is not None and observation.gripper.closed_on_nothing
    why = "the gripper closed on nothing while holding" if nothing else "the gripper no longer holds anything"
    return state, Fault(FaultCode.OBJECT_LOST, why, LOOK)
