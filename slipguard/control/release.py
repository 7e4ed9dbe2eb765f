"""Release on request. If the arm may be moving, it is stopped before the jaws open.

After a release request, the object is neither guarded nor tightened until a person requests it.
"""

from __future__ import annotations

import math
from dataclasses import replace

from slipguard.control import arm_motion
from slipguard.control.arm_motion import REPEAT_S, Result
from slipguard.control.messages import Observation, ReleaseJaws, StepOutput, StopArm
from slipguard.control.params import GuardParams
from slipguard.control.reports import Fault, FaultCode, Text
from slipguard.control.state import GraspState, HandsOff, Phase, Release

OPEN_ANYWAY_S = 0.5
"""The jaws open at the latest this long after the request, even if the arm does not report that it stands."""


def request_release(state: GraspState, observation: Observation, params: GuardParams) -> Result:
    """Grant a release, in every phase. Repeating the request does not prolong the wait for the arm."""
    requested_mm = observation.request.width_mm
    width_mm = requested_mm if requested_mm is not None else params.release_width_mm
    if state.release is not None and _waits(state):
        release = replace(state.release, width_mm=width_mm)
        return _open(state, release, observation, StepOutput().with_messages(Text.RELEASING.message()))
    arm = observation.arm
    at_rest = arm is not None and arm_motion.has_ended(state, arm, observation.now_s)
    release = Release(width_mm, arm_may_move=not at_rest)
    state = state.emptied(Phase.RELEASED, observation.now_s)
    state = replace(state, release=release, hands_off=HandsOff(release_requested=True))
    if at_rest:
        return _open(state, release, observation, StepOutput().with_messages(Text.RELEASING.message()))
    message = Text.RELEASING_WHEN_ARM_STANDS.message(wait_s=OPEN_ANYWAY_S)
    return arm_motion.stop(state, observation, StepOutput().with_messages(message), at_once=True)


def continue_release(
    state: GraspState, observation: Observation, params: GuardParams
) -> tuple[GraspState, StepOutput, Fault | None]:
    """Go on releasing, for one step: over when the jaws are open and the arm stands; a fault if they do not open."""
    release = state.release or Release(params.release_width_mm)
    state, release, output = _stop_arm(state, release, observation)
    if _waits(state):
        return *_open(state, release, observation, output), None
    gripper, now_s, grip, tuning = observation.gripper, observation.now_s, state.grip, params.tuning
    late = now_s - state.since_s > tuning.stuck_timeout_s
    if gripper is not None and gripper.measured_at_s > grip.commanded_s and not gripper.moving:
        if not gripper.holding and release.arm_may_move and not late:
            return state, output, None
        if not gripper.holding:
            message = (Text.RELEASED_ARM_UNKNOWN if release.arm_may_move else Text.RELEASED).message()
            return state.emptied(Phase.IDLE, now_s), output.with_messages(message), None
        if now_s - grip.commanded_s >= REPEAT_S:
            return *_command_open(state, release, observation, output), None
    moving = gripper is not None and gripper.moving
    if now_s - state.since_s <= tuning.stuck_timeout_s + tuning.closing_timeout_s * moving:
        return state, output, None
    fault = Fault(
        FaultCode.GRIPPER_STUCK,
        f"not open {now_s - state.since_s:.1f} s after the release",
        "check the gripper, then release again; meanwhile the object is neither guarded nor tightened",
    )
    return state, output, fault


def _waits(state: GraspState) -> bool:
    """Return whether the jaws have not been commanded to open yet."""
    return state.phase is Phase.RELEASED and state.grip.commanded_s == -math.inf


def _stop_arm(state: GraspState, release: Release, observation: Observation) -> tuple[GraspState, Release, StepOutput]:
    """Stop an arm that may move, until it has reported once that it stands; then it is free."""
    arm, now_s = observation.arm, observation.now_s
    if not release.arm_may_move:
        return state, release, StepOutput()
    if arm is not None and arm_motion.is_current(state, arm, now_s) and not arm.moving:
        release = replace(release, arm_may_move=False)
        return replace(state, release=release), release, StepOutput()
    if now_s - state.arm.commanded_s < REPEAT_S:
        return state, release, StepOutput()
    return replace(state, arm=replace(state.arm, commanded_s=now_s)), release, StepOutput(arm=StopArm())


def _open(state: GraspState, release: Release, observation: Observation, output: StepOutput) -> Result:
    """Open the jaws if the arm stands or has been waited for long enough."""
    if release.arm_may_move and observation.now_s - state.since_s < OPEN_ANYWAY_S:
        return replace(state, release=release), output
    return _command_open(replace(state, since_s=observation.now_s), release, observation, output)


def _command_open(state: GraspState, release: Release, observation: Observation, output: StepOutput) -> Result:
    grip = replace(state.grip, commanded_s=observation.now_s)
    return replace(state, grip=grip, release=release), replace(output, gripper=ReleaseJaws(release.width_mm))
