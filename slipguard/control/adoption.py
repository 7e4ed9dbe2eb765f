"""What was held before a restart: waited for, taken over as it is, and guarded or kept under the fault of before.

A force that the gripper had taken is believed and not said again, for a new hold is a stop and a go. One that was only
commanded may never have arrived: it is the law's target again and is said until the gripper takes it, as any force is.
"""

from __future__ import annotations

from dataclasses import replace

from slipguard.control import force_limits as limits
from slipguard.control.messages import Command, Observation
from slipguard.control.params import GuardParams
from slipguard.control.state import GraspState, as_wide, taken_over, waiting
from slipguard.devices import GripperState

Outcome = tuple[GraspState, Command]


def undecided(state: GraspState, gripper: GripperState) -> bool:
    """Whether jaws that were left holding something are on their way still: they may be tightening what they hold."""
    return waiting(state) and gripper.moving and not gripper.holding


def adopt(state: GraspState, gripper: GripperState, observation: Observation, params: GuardParams) -> Outcome:
    """An object held since before the start is taken over once a finger speaks; a slow arm keeps nothing unguarded."""
    if observation.fused is not None:
        state, said = _held(state, gripper, observation, params)
        return state, Command(say=said)
    first = not state.found
    said = f"an object is held with {gripper.force_n:.0f} N already: waiting for a finger"
    return replace(state, found=True), Command(say=said if first else None)


def adopt_in_fault(state: GraspState, observation: Observation, params: GuardParams) -> tuple[GraspState, str | None]:
    """The same under a latched fault, as soon as the gripper speaks: the arm stands, so no finger is waited for.

    A turn told later is one since a reference, by which the object may turn out to be lost.
    """
    gripper, fused = observation.gripper, observation.fused
    if state.gripped and not state.referenced and state.blind is None:
        told = fused is not None and fused.rotation_deg is not None and fused.measured_at_s >= state.since_s
        return (replace(state, referenced=True) if told else state), None
    if state.adopted or gripper is None or undecided(state, gripper):
        return state, None
    if not gripper.holding or state.hands_off:
        return replace(state, adopted=True, remembered=None), None
    held, said = _held(state, gripper, observation, params)
    return replace(
        state, target_n=held.target_n, commanded_s=held.commanded_s, gripped=True, adopted=True, remembered=None
    ), said


def _held(
    state: GraspState, gripper: GripperState, observation: Observation, params: GuardParams
) -> tuple[GraspState, str]:
    """What the gripper holds, taken over, and how that is said."""
    before = state.remembered
    state = taken_over(state, gripper, observation.now_s)
    said = f"an object is held with {gripper.force_n:.0f} N already: taken over as it is"
    within = limits.budget(params.force_max_n, observation.gripper_limits_n)
    if before is not None and not before.applied and as_wide(before, gripper) and within is not None:
        asked_n = limits.allowed(before.force_n, state.target_n, within)
        if asked_n > state.target_n:
            said = f"{said}; the {asked_n:.0f} N asked for before the restart are asked for again"
            return replace(state, target_n=asked_n, commanded_s=observation.now_s), said
    known = f", with the {state.target_n:.0f} N of before the restart" if state.target_n > gripper.force_n else ""
    return state, f"{said}{known}"
