"""Release on request. If the arm may be moving, it is stopped before the jaws open.

After a release request, the object is neither guarded nor tightened until a person requests it. It counts as released
once the gripper reports that the jaws have opened, they have become wider, and no finger sees contact any more. That
the jaws neither move nor hold anything is not enough: a gripper that is not active reports just that.
"""

from __future__ import annotations

import math
from dataclasses import replace

from slipguard.control import arm_motion
from slipguard.control.arm_motion import Result
from slipguard.control.finger_fusion import FusedEstimate
from slipguard.control.messages import Observation, ReleaseJaws, StepOutput, StopArm
from slipguard.control.params import GuardParams
from slipguard.control.reports import Fault, FaultCode, Message, Text
from slipguard.control.state import SAME_WIDTH_MM, GraspState, HandsOff, Phase, Release
from slipguard.devices import ACTIVATION_HINT, GripperState

OPEN_ANYWAY_S = 0.5
"""The jaws open at the latest this long after the request, even if the arm does not report that it stands."""
REPEAT_S = 0.25
"""A command without effect is repeated after this time; a Robotiq shows within 0.2 s that it moves."""


def request_release(state: GraspState, observation: Observation, params: GuardParams) -> Result:
    """Grant a release, in every phase. Repeating the request does not prolong the wait for the arm."""
    requested_mm = observation.request.width_mm
    width_mm = requested_mm if requested_mm is not None else params.release_width_mm
    if state.release is not None and _waits(state):
        release = replace(state.release, width_mm=width_mm)
        return _open(state, release, observation, StepOutput().with_messages(Text.RELEASING.message()))
    arm = observation.arm
    at_rest = arm is not None and arm_motion.has_ended(state, arm, observation.now_s)
    release = Release(width_mm, arm_may_move=not at_rest, held=_may_hold(state, observation))
    state = state.emptied(Phase.RELEASED, observation.now_s)
    release = _follow_jaws(state, release, observation)
    state = replace(state, release=release, hands_off=HandsOff(release_requested=True))
    if at_rest:
        return _open(state, release, observation, StepOutput().with_messages(Text.RELEASING.message()))
    message = Text.RELEASING_WHEN_ARM_STANDS.message(wait_s=OPEN_ANYWAY_S)
    return arm_motion.stop(state, observation, StepOutput().with_messages(message), at_once=True)


def continue_release(
    state: GraspState, observation: Observation, params: GuardParams
) -> tuple[GraspState, StepOutput, Fault | None]:
    """Go on releasing, for one step: over when the object is out and the arm stands; a fault if it does not get there.

    A gripper that loses its power on the way, or opens slowly, has time as long as the jaws become wider.
    """
    release = state.release or Release(params.release_width_mm)
    state, release, output = _stop_arm(state, release, observation)
    release = _follow_jaws(state, release, observation)
    state = replace(state, release=release)
    if _waits(state):
        return *_open(state, release, observation, output), None
    now_s = observation.now_s
    progress_s = max(state.since_s, release.widened_s, release.opened_s or -math.inf)
    late = now_s - progress_s > params.tuning.stuck_timeout_s
    nothing = late and not release.held and _is_usable(observation.gripper)
    if (nothing or release.opened_s is not None) and _is_out(release, observation.fused):
        if release.arm_may_move and not late:
            return state, output, None
        messages = _released(release, observation.gripper)
        return state.emptied(Phase.IDLE, now_s), output.with_messages(*messages), None
    if late:
        return state, output, _not_released(state, release, observation)
    gripper = observation.gripper
    answered = gripper is not None and gripper.measured_at_s > state.grip.commanded_s and not gripper.moving
    if answered and release.opened_s is None and now_s - state.grip.commanded_s >= REPEAT_S:
        return *_command_open(state, release, observation, output), None
    return state, output, None


def _may_hold(state: GraspState, observation: Observation) -> bool:
    """Return whether the jaws may hold something; not only if the gripper and the fingers say so."""
    gripper, fused = observation.gripper, observation.fused
    if state.phase is not Phase.IDLE or state.hands_off or gripper is None or not gripper.active:
        return True
    touched = fused is not None and True in (fused.left_contact, fused.right_contact)
    return gripper.fault is not None or gripper.holding or gripper.moving or touched


def _follow_jaws(state: GraspState, release: Release, observation: Observation) -> Release:
    """Follow how wide the jaws are, and since when the gripper reports at rest that they are open."""
    gripper, now_s = observation.gripper, observation.now_s
    if gripper is None:
        return replace(release, opened_s=None)
    width_mm = gripper.width_mm
    if width_mm < release.from_mm:
        release = replace(release, from_mm=width_mm, to_mm=width_mm)
    elif width_mm - release.to_mm > SAME_WIDTH_MM:
        release = replace(release, to_mm=width_mm, widened_s=now_s)
    wider = width_mm - release.from_mm > SAME_WIDTH_MM
    opened = wider or (not release.held and width_mm >= release.width_mm - SAME_WIDTH_MM)
    opened = opened and (gripper.auto_released or _is_usable(gripper))
    if not opened or gripper.moving or gripper.measured_at_s <= state.grip.commanded_s:
        return replace(release, opened_s=None)
    return release if release.opened_s is not None else replace(release, opened_s=now_s)


def _is_usable(gripper: GripperState | None) -> bool:
    """Return whether the gripper can know, and reports at rest, that it holds nothing."""
    if gripper is None or not gripper.active or gripper.fault is not None:
        return False
    return not (gripper.holding or gripper.moving)


def _is_out(release: Release, fused: FusedEstimate | None) -> bool:
    """Return whether a finger reports since the jaws are open that nothing touches it, and none reports contact.

    Where nothing was held it is enough that none reports contact.
    """
    contacts = (None, None) if fused is None else (fused.left_contact, fused.right_contact)
    if True in contacts:
        return False
    if fused is None or False not in contacts:
        return not release.held
    return fused.measured_at_s > (release.opened_s or 0.0)


def _released(release: Release, gripper: GripperState | None) -> tuple[Message, ...]:
    width_mm = gripper.width_mm if gripper is not None else release.to_mm
    text = Text.RELEASED_ARM_UNKNOWN if release.arm_may_move else Text.RELEASED
    if not release.held:
        text = Text.NOTHING_RELEASED
    messages = (text.message(from_mm=release.from_mm, to_mm=width_mm),)
    if gripper is not None and gripper.auto_released:
        return *messages, Text.ACTIVATE_NEXT.message(hint=ACTIVATION_HINT)
    return messages


def _not_released(state: GraspState, release: Release, observation: Observation) -> Fault:
    """Return the fault with what is known about jaws and object."""
    gripper, fused = observation.gripper, observation.fused
    if gripper is None or gripper.measured_at_s <= state.grip.commanded_s:
        observed = "the gripper does not respond, so it is unknown whether the jaws have opened"
        todo = "without power its jaws keep the grip: support the object, give the gripper power, then release again"
        return Fault(FaultCode.NOT_RELEASED, observed, todo)
    contacts = {} if fused is None else {"left": fused.left_contact, "right": fused.right_contact}
    touched = [name for name, contact in contacts.items() if contact]
    seen = "no finger sees contact" if False in contacts.values() else "no finger can see whether the object is out"
    if touched:
        seen = f"the {' and the '.join(touched)} finger still {'sees' if len(touched) == 1 else 'see'} contact"
    held = ", the gripper still holds something" if gripper.holding else ""
    observed = f"the jaws report {gripper.width_mm:.0f} mm, {release.from_mm:.0f} mm before{held}; {seen}"
    if not gripper.active and not gripper.auto_released:
        observed += f"; the gripper is not active{f': {gripper.fault}' if gripper.fault else ''}"
        todo = "support the object, switch the gripper off and on, then release again; if the jaws are empty, clear"
    elif release.opened_s is not None or gripper.auto_released:
        todo = "support the object and take it out of the jaws, then clear"
    else:
        todo = "support the object, find what blocks the jaws, then release again; if they are empty, clear"
    return Fault(FaultCode.NOT_RELEASED, observed, todo)


def _waits(state: GraspState) -> bool:
    """Return whether the jaws have not been commanded to open yet."""
    return state.phase is Phase.RELEASED and state.grip.commanded_s == -math.inf


def _stop_arm(state: GraspState, release: Release, observation: Observation) -> tuple[GraspState, Release, StepOutput]:
    """Stop an arm that may move, until it has reported once that it stands; then it is free."""
    arm, now_s = observation.arm, observation.now_s
    if not release.arm_may_move:
        return state, release, StepOutput()
    if arm is not None and arm_motion.is_current(state, arm, now_s) and not arm.moving:
        return state, replace(release, arm_may_move=False), StepOutput()
    if now_s - state.arm.commanded_s < arm_motion.REPEAT_S:
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
