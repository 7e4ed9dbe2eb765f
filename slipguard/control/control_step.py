"""One control step: from what is observed to what is commanded. Pure; the daemon calls it once per cycle.

    observation -> follow the arm, supervise, watch the object: what is wrong now
                -> release          granted at once, in every phase
                -> stop             granted in every phase, on top of all that follows (stop.py)
                -> fault            latched if an object is at stake
                -> act              what the present phase does (phases.py, force_law.py)
                -> keep the force   repeat a force the gripper did not take
                -> halt the jaws    if a person may be near
                -> notes            what a finger cannot estimate
                -> request          granted or refused (requests.py)
                -> output

At any failure the grip is kept, the arm stops, and it is reported. Only a release request opens the jaws.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

from slipguard.control import force_limits
from slipguard.control.arm_motion import REPEAT_S, Result, follow_start
from slipguard.control.messages import (
    NO_REQUEST,
    HaltJaws,
    HoldForce,
    Observation,
    RequestKind,
    StepOutput,
    without_figures,
)
from slipguard.control.object_presence import late_contact, watch_object
from slipguard.control.params import GuardParams
from slipguard.control.phases import act, latch
from slipguard.control.release import request_release
from slipguard.control.reports import Fault, FaultCode, Text
from slipguard.control.requests import handle_request
from slipguard.control.state import AT_STAKE, FORCE_TOLERANCE_N, GraspState, PersonNear, Phase
from slipguard.control.stop import follow_stop, request_stop
from slipguard.control.supervisor import Supervision, supervise

CARRIED_MM = 3.0
"""An object that was lifted this far is carried, at least at one end."""
NOTED_IN = AT_STAKE - {Phase.CLOSING, Phase.REFERENCE}
"""Phases in which a finger without an estimate is reported; in FAULT, too, while an object is held."""
NOTE_OVER_S = 1.0
"""What comes and goes within this time is reported once."""


@dataclass(frozen=True, slots=True)
class ControlState:
    """Memory of the controller and of the supervisor. A new one adopts what the gripper holds at the start."""

    grasp: GraspState = field(default_factory=GraspState)
    supervision: Supervision = field(default_factory=Supervision)


def control_step(state: ControlState, observation: Observation, params: GuardParams) -> tuple[ControlState, StepOutput]:
    """Return the next state and what to command now.

    Args:
        state: returned by the step before.
        observation: without faults; the supervisor fills them in here.
        params: may change between steps.
    """
    supervision, faults = supervise(state.supervision, state.grasp, observation, params)
    if faults:
        observation = replace(observation, fault=faults[0], other_faults=faults[1:])
    grasp, output = step(state.grasp, observation, params)
    return ControlState(grasp, supervision), output


def step(state: GraspState, observation: Observation, params: GuardParams) -> Result:
    """Return the controller's next state and output, faults given."""
    params = params.limited(state.grip.limit_n)
    state = _follow_arm(state, observation)
    if observation.request.kind is RequestKind.RELEASE:
        return request_release(state, observation, params)
    if observation.request.kind is RequestKind.STOP:
        return request_stop(*step(state, replace(observation, request=NO_REQUEST), params), observation)
    unwatched = state
    state, lost = watch_object(state, observation, params)
    watched = observation if lost is None else observation.with_fault(lost)
    at_stake = state.phase in AT_STAKE or (state.phase is Phase.IDLE and state.waits_for_gripper)
    if watched.fault is not None and at_stake:
        before = state.phase
        state, output = latch(state, watched, watched.fault, StepOutput())
        if before in NOTED_IN:
            state, output = _grip_unseen(state, output, observation, params)
        state, output = _halt(state, output, observation, params)
        return state, _refuse_request(watched.fault, output, observation)
    before = state.phase
    state, output = act(state, watched, params)
    state, output = _keep_force(state, output, observation)
    state, output = _halt(state, output, observation, params)
    late = late_contact(unwatched, state, observation)
    if late is not None:
        output = replace(output, is_warning=True).with_messages(late)
    state, output = _report_notes(state, output, observation)
    if state.fault is not None and state.phase is Phase.FAULT and before is not Phase.FAULT:
        output = _refuse_request(state.fault, output, observation)
    else:
        state, output = handle_request(state, output, observation, params)
    return state, replace(output, fault=state.fault)


def _refuse_request(fault: Fault, output: StepOutput, observation: Observation) -> StepOutput:
    """Refuse the request of the step in which a fault is latched: it was made before the fault was reported."""
    if observation.request.kind is RequestKind.NONE:
        return output
    return replace(output, refusal=Text.FAULT_LATCHED.message(code=fault.code))


def _grip_unseen(state: GraspState, output: StepOutput, observation: Observation, params: GuardParams) -> Result:
    """Grip an object that is carried and whose rotation no finger can estimate any more, as one without an estimate.

    It may have slipped beyond what the fingers can follow.
    """
    fault, fused, arm, start_mm = state.fault, observation.fused, observation.arm, state.held.load.lowest_mm
    carried = arm is not None and start_mm is not None and arm.height_mm - start_mm > CARRIED_MM
    if fault is None or fault.code is not FaultCode.ESTIMATE_UNTRUSTED or not carried or state.person.forbids_force:
        return state, output
    force_range = force_limits.present_range(params, observation)
    if fused is None or fused.rotation_deg is not None or force_range is None:
        return state, output
    target_n = force_range.allowed(params.no_estimate_force_n, state.grip.target_n)
    if target_n <= state.grip.target_n:
        return state, output
    message = Text.NO_ESTIMATE_GRIP.message(why=fused.declined, force_n=target_n)
    output = replace(output, gripper=HoldForce(target_n)).with_messages(message)
    return state.with_target(target_n, observation.now_s), output


def _follow_arm(state: GraspState, observation: Observation) -> GraspState:
    """Return the state with what the arm reports about a stop of its own."""
    arm = observation.arm
    if arm is None:  # an arm that comes back counts its height from where it is found
        return replace(state, arm=replace(state.arm, ground_mm=None))
    state = follow_start(state, arm)
    near, before = arm.protective_stop or arm.emergency_stop, state.person
    after_stop = not near and before.forbids_force and state.phase is Phase.FAULT
    if near is before.now and after_stop is before.after_stop:
        return state
    return replace(state, person=PersonNear(near, after_stop=after_stop))


def _keep_force(state: GraspState, output: StepOutput, observation: Observation) -> Result:
    """Repeat the force if the gripper did not take it: a lost command must not leave the grip weak."""
    gripper, grip, now_s = observation.gripper, state.grip, observation.now_s
    held = (state.phase in AT_STAKE or state.phase is Phase.FAULT) and not state.hands_off
    if not held or gripper is None or state.person.forbids_force or output.hold_force_n is not None:
        return state, output
    if grip.commanded_s == -math.inf:
        return state, output  # a grip that was taken over is left as it is
    weak = gripper.force_n < grip.target_n - FORCE_TOLERANCE_N and (gripper.holding or state.phase is Phase.CLOSING)
    current = gripper.measured_at_s > grip.commanded_s and now_s - grip.commanded_s >= REPEAT_S
    if not (weak and current):
        return state, output
    return state.with_target(grip.target_n, now_s), replace(output, gripper=HoldForce(grip.target_n))


def _halt(state: GraspState, output: StepOutput, observation: Observation, params: GuardParams) -> Result:
    """Halt what moves against a requested stop, or while a person may be near."""
    state, output = follow_stop(state, output, observation, params)
    return _halt_jaws(state, output, observation)


def _halt_jaws(state: GraspState, output: StepOutput, observation: Observation) -> Result:
    """Halt moving jaws while a person may be near or after a stop, until they report that they rest.

    The grip is kept, and its force is commanded again after `clear`. A closing that was interrupted is not resumed: the
    jaws may have met a hand, so the grasp must be requested again. A release goes on.
    """
    gripper, commanded_s, person = observation.gripper, state.grip.commanded_s, state.person
    opening = state.hands_off.release_requested and commanded_s > -math.inf
    stopped = state.stop is not None and state.stop.jaws
    if not (person.now or stopped) or opening or gripper is None:
        return state, output
    if not (gripper.moving or gripper.measured_at_s <= commanded_s):
        return state, output
    if observation.now_s - person.halted_s < REPEAT_S:
        return state, output
    first = person.now and person.halted_s == -math.inf
    without_grip = state.adoption.done and not state.grip.closed
    interrupted = without_grip and (stopped or state.phase in (Phase.CLOSING, Phase.FAULT))
    hands_off = state.hands_off
    hands_off = replace(hands_off, closing_interrupted=hands_off.closing_interrupted or interrupted)
    state = replace(state, person=replace(person, halted_s=observation.now_s), hands_off=hands_off)
    return state, replace(output, gripper=HaltJaws()).with_messages(Text.JAWS_HALTED.message() if first else None)


def _report_notes(state: GraspState, output: StepOutput, observation: Observation) -> Result:
    """Report once that a finger gives no estimate or that the two contradict each other, and when that is over."""
    fused, reported, now_s = observation.fused, state.reported, observation.now_s
    if not (state.phase in NOTED_IN or (state.phase is Phase.FAULT and state.grip.closed)):
        return replace(state, reported=replace(reported, note=None)), output
    if fused is None:
        return state, output
    note = fused.conflict or fused.shift_conflict or fused.note or fused.declined
    if note is not None:
        if reported.note is not None and without_figures(reported.note) == without_figures(note):
            return replace(state, reported=replace(reported, noted_s=now_s)), output
        output = output.with_messages(Text.FINGER_NOTE.message(note=note))
        return replace(state, reported=replace(reported, note=note, noted_s=now_s)), output
    if reported.note is None or now_s - reported.noted_s < NOTE_OVER_S:
        return state, output
    output = output.with_messages(Text.FINGER_NOTE_OVER.message(note=reported.note))
    return replace(state, reported=replace(reported, note=None)), output
