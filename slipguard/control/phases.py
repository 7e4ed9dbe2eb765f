"""What the controller does in each phase of a grasp, requests apart."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

from slipguard.control import arm_motion, force_limits
from slipguard.control.arm_motion import REACHED_MM, Result
from slipguard.control.force_law import Guarding, guard
from slipguard.control.messages import HoldForce, Observation, StepOutput, StopArm
from slipguard.control.params import GuardParams
from slipguard.control.release import continue_release
from slipguard.control.reports import Fault, FaultCode, Message, Text
from slipguard.control.state import Adoption, GraspState, Phase, force_text, gripper_at_rest
from slipguard.devices import GripperState

NOTHING_S = 0.1
"""A gripper that reports this long that it has closed on nothing has; one report may be out of date."""
AGAIN_TIMES = 1.05
"""Of the grip: a contact that is seen again differs by less."""


def act(state: GraspState, observation: Observation, params: GuardParams) -> Result:
    """Return the state and output of the present phase."""
    return _PHASES[state.phase](state, observation, params)


def latch(state: GraspState, observation: Observation, fault: Fault, output: StepOutput) -> Result:
    """Enter FAULT: keep the grip, stop the arm, report the fault."""
    state = replace(state.entered(Phase.FAULT, observation.now_s), fault=fault)
    state = replace(
        state,
        arm=replace(state.arm, commanded_s=observation.now_s),
        reported=replace(state.reported, faults=frozenset({fault.code})),
    )
    output = replace(output, arm=StopArm(), fault=fault).with_messages(fault.message())
    return _report_other_faults(state, observation, output)


def _idle(state: GraspState, observation: Observation, params: GuardParams) -> Result:
    """Nothing is held, or an object that slipguard is not to guard."""
    gripper = observation.gripper
    if gripper is None:
        return state, StepOutput()
    if gripper.holding and not state.adoption.done:
        return _adopt(state, gripper, observation, params)
    if _undecided(state, gripper):
        return state, StepOutput()
    before = state.adoption.remembered
    outdated = state.adoption.outdated and not gripper.active
    state = replace(state, adoption=Adoption(done=True, found=state.adoption.found, outdated=outdated))
    if before is not None:
        gone = Text.NOT_HELD_ANY_MORE.message(known_n=before.force_n, width_mm=before.width_mm)
        return state, StepOutput(messages=(gone,), is_warning=True)
    touched = observation.fused is not None and observation.fused.both_touch
    interrupted = state.hands_off.closing_interrupted
    if params.mode == "guard" and state.guarding and gripper.holding and touched and not interrupted:
        message = Text.GUARDING_FOUND.message(force=force_text(gripper, gripper.force_n))
        return state.taken_over(gripper, observation.now_s), StepOutput(new_reference=True, messages=(message,))
    return state, StepOutput()


def _closing(state: GraspState, observation: Observation, params: GuardParams) -> Result:
    """The jaws close with the first force."""
    gripper, now_s = observation.gripper, observation.now_s
    delay = state.grip.delay.measured(state.grip.commanded_s, gripper)
    state = replace(state, grip=replace(state.grip, delay=delay))
    if gripper is not None and gripper.measured_at_s > state.since_s:
        if gripper.holding and not gripper.moving and gripper.force_n > 0.0:  # 0: halted by an earlier stop
            state = state.entered(Phase.REFERENCE, now_s)
            state = replace(state, grip=replace(state.grip, closed=True))
            return state, StepOutput(new_reference=True, messages=(Text.GRIPPED.message(),))
        state = _follow_nothing(state, gripper)
        since_s = state.grip.nothing_since_s
        if since_s is not None and gripper.measured_at_s - since_s >= NOTHING_S:
            return state.emptied(Phase.IDLE, now_s), StepOutput(messages=(Text.CLOSED_ON_NOTHING.message(),))
        if since_s is not None:
            return state, StepOutput()
    timeout_s = params.tuning.closing_timeout_s
    if now_s - state.since_s > timeout_s:
        where = ""
        if gripper is not None and not (gripper.moving or gripper.holding):
            where = f": the jaws stand {gripper.width_mm:.0f} mm apart without one"
        fault = Fault(
            FaultCode.GRIPPER_STUCK,
            f"not closed on an object within {timeout_s:g} s{where}",
            "keep your hands out of the jaws, which may still close; support what is between them, then release; or "
            "check the gripper's cable, then clear",
        )
        return latch(state, observation, fault, StepOutput())
    return state, StepOutput()


def _follow_nothing(state: GraspState, gripper: GripperState) -> GraspState:
    """Follow since when the gripper reports at rest that it has closed on nothing."""
    since_s = state.grip.nothing_since_s
    nothing = gripper.closed_on_nothing and not gripper.moving
    if nothing == (since_s is not None):
        return state
    return replace(state, grip=replace(state.grip, nothing_since_s=gripper.measured_at_s if nothing else None))


def _reference(state: GraspState, observation: Observation, params: GuardParams) -> Result:
    """Wait until both fingers have their reference; after the timeout one is enough, or none with a firmer grip.

    A grip that is too weak for the contact that they show is made firmer first, and then they take another reference.
    """
    fused, now_s, present_n = observation.fused, observation.now_s, state.grip.target_n
    doubted = state.held.lost_since_s is not None  # no grip is made firmer for an object that no finger sees
    waited = now_s - state.since_s > params.tuning.reference_timeout_s and not doubted
    estimated = fused is not None and fused.rotation_deg is not None and fused.measured_at_s >= state.since_s
    force = force_text(observation.gripper, present_n)
    ready = fused is not None and estimated and len(fused.fingers) == 2
    if not (ready or waited):
        return state, StepOutput()
    state, firmer = _grip_for_contact(state, observation, params)
    if firmer is not None:
        return state, firmer
    if fused is not None and estimated:
        state = _holding_since(state, now_s, None)
        if len(fused.fingers) == 1:
            return state, _saying(Text.HOLDING_BY_ONE_FINGER.message(force=force, note=fused.note))
        return state, _saying(Text.HOLDING.message(force=force))
    why = (fused.declined if fused is not None else None) or "no frames from either finger"
    state = _holding_since(state, now_s, why)
    if params.on_no_estimate == "refuse" or not state.guarding:
        return state, _saying(Text.NO_ESTIMATE.message(why=why))
    force_range = force_limits.present_range(params, observation)
    target_n = force_range.allowed(params.no_estimate_force_n, present_n) if force_range is not None else 0.0
    output = _saying(Text.NO_ESTIMATE_GRIP.message(why=why, force_n=max(target_n, present_n)))
    if target_n <= present_n or state.person.now:
        return state, output
    return state.with_target(target_n, now_s), replace(output, gripper=HoldForce(target_n))


def _grip_for_contact(
    state: GraspState, observation: Observation, params: GuardParams
) -> tuple[GraspState, StepOutput | None]:
    """Return the state with the contact seen, and a firmer grip if the given object needs it for that contact.

    A grip that was taken over, or requested to be weaker than the object needs, is left as it is.
    """
    fused, gripper, present_n = observation.fused, observation.gripper, state.grip.target_n
    radius_mm = fused.contact_radius_mm if fused is not None else None
    pad = force_limits.seen_pad(radius_mm, present_n)
    state = replace(state, held=replace(state.held, pad=pad))
    needed_n = params.modelled_n(pad)
    force_range = force_limits.present_range(params, observation)
    if needed_n is None or force_range is None or needed_n <= AGAIN_TIMES * present_n:
        return state, None
    own = state.grip.commanded_s > -math.inf and present_n >= force_limits.first_n(params)
    target_n = force_range.allowed(needed_n, present_n)
    firm = gripper is not None and gripper_at_rest(state, gripper)
    if not (own and firm) or target_n <= present_n or state.person.forbids_force:
        return state, None
    radius_mm = force_limits.UNSEEN_MM if radius_mm is None else radius_mm
    message = Text.GRIPPING_FOR_CONTACT.message(radius_mm=radius_mm, needed_n=needed_n, force_n=target_n)
    state = state.entered(Phase.REFERENCE, observation.now_s).with_target(target_n, observation.now_s)
    return state, StepOutput(HoldForce(target_n), new_reference=True, messages=(message,))


def _holding_since(state: GraspState, now_s: float, no_estimate: str | None) -> GraspState:
    state = state.entered(Phase.HOLDING, now_s)
    return replace(state, held=replace(state.held, referenced=no_estimate is None, no_estimate=no_estimate))


def _saying(message: Message) -> StepOutput:
    return StepOutput(messages=(message,))


def _holding(state: GraspState, observation: Observation, params: GuardParams) -> Result:
    """Respond to slip. The arm is another program's or at rest; it is stopped while the object slips."""
    response = guard(state, observation, params)
    state, output = response.state, _output_of(response)
    if response.fault is not None:
        return arm_motion.put_down(latch(state, observation, response.fault, output), observation, params)
    lost_since_s = state.held.lost_since_s
    perhaps_lost = lost_since_s is not None and observation.now_s - lost_since_s >= params.tuning.lost_after_s
    if (response.stop_arm and params.stop_on_slip) or perhaps_lost:
        slip = state.held.slip
        began = slip is not None and slip.began_s == observation.now_s
        state = replace(state, arm=replace(state.arm, paused=True))
        return arm_motion.stop(state, observation, output, at_once=began)
    return state, output


def _output_of(response: Guarding) -> StepOutput:
    hold = None if response.hold_n is None else HoldForce(response.hold_n)
    return StepOutput(hold, is_warning=response.stop_arm).with_messages(response.message)


def _moving(state: GraspState, observation: Observation, params: GuardParams) -> Result:
    """Lift or lower, leg by leg; stop while the object slips, and continue when it has settled."""
    state, output = _holding(state, observation, params)
    arm, motion, held = observation.arm, state.arm, state.held
    if state.phase is Phase.FAULT or arm is None or motion.goal_mm is None or held.slip is not None:
        return state, output
    leg = arm_motion.next_leg(state, arm, params)
    due = arm_motion.has_ended(state, arm, observation.now_s)
    due = due or arm_motion.may_speed_up(state, arm, observation.now_s, leg)
    if held.lost_since_s is not None or not due:
        return state, output
    if abs(motion.goal_mm - arm.height_mm) <= REACHED_MM:
        message = Text.ARRIVED.message(height_mm=arm.height_mm)
        return state.entered(Phase.HOLDING, observation.now_s), output.with_messages(message)
    output = replace(output, arm=leg)
    state = replace(state, arm=replace(motion, paused=False, commanded_s=observation.now_s))
    return state, output.with_messages(Text.ARM_CONTINUES.message() if motion.paused else None)


def _released(state: GraspState, observation: Observation, params: GuardParams) -> Result:
    """Open as requested; repeated if nothing happens, given up after `stuck_timeout_s`."""
    state, output, fault = continue_release(state, observation, params)
    return (state, output) if fault is None else latch(state, observation, fault, output)


def _fault(state: GraspState, observation: Observation, params: GuardParams) -> Result:
    """The arm stands and the grip is kept; slip is still met with force where that is allowed and possible."""
    state, message = _adopt_in_fault(state, observation, params)
    response = Guarding(state) if state.hands_off else guard(state, observation, params)
    output = replace(_output_of(response), messages=()).with_messages(message, response.message)
    state, output = _report_other_faults(response.state, observation, output, response.fault)
    gripper = observation.gripper
    if gripper is not None and gripper.holding and not state.hands_off:
        state = replace(state, grip=replace(state.grip, closed=True))
    if state.arm.putting_down:
        return arm_motion.continue_down(state, observation, output, params)
    return arm_motion.stop(state, observation, output)


def _report_other_faults(
    state: GraspState, observation: Observation, output: StepOutput, found: Fault | None = None
) -> Result:
    """Report what else is wrong while a fault is latched, once for each time."""
    wrong = {fault.code: fault for fault in (*observation.faults, found) if fault is not None}
    latched = {state.fault.code} if state.fault is not None else set()
    new = [fault.message() for code, fault in wrong.items() if code not in state.reported.faults]
    output = replace(output, is_warning=output.is_warning or bool(new)).with_messages(*new)
    return replace(state, reported=replace(state.reported, faults=frozenset(wrong) | latched)), output


# --- what was held before a restart ---
# A force that the gripper had confirmed is not commanded again, for a new hold is a stop and a go. One that was only
# commanded may never have arrived: it is the target again, and repeated until the gripper confirms it.


def _undecided(state: GraspState, gripper: GripperState) -> bool:
    """Return whether the jaws still move after a restart: they may be closing or tightening on an object."""
    return not state.adoption.done and gripper.moving and not gripper.holding


def _adopt(state: GraspState, gripper: GripperState, observation: Observation, params: GuardParams) -> Result:
    """Take over an object held since before the start, as soon as a finger gives an estimate."""
    if observation.fused is not None:
        state, message = _taken_over(state, gripper, observation, params)
        return state, _saying(message)
    first = not state.adoption.found
    message = Text.WAITING_FOR_FINGER.message(force=force_text(gripper, gripper.force_n))
    state = replace(state, adoption=replace(state.adoption, found=True))
    return state, _saying(message) if first else StepOutput()


def _adopt_in_fault(
    state: GraspState, observation: Observation, params: GuardParams
) -> tuple[GraspState, Message | None]:
    """Do the same under a latched fault, as soon as the gripper reports: the arm stands, so no finger is waited for.

    A later rotation estimate counts from a reference, which may show that the object is lost.
    """
    gripper, fused, held = observation.gripper, observation.fused, state.held
    if state.grip.closed and not held.referenced and held.no_estimate is None:
        referenced = fused is not None and fused.rotation_deg is not None and fused.measured_at_s >= state.since_s
        return replace(state, held=replace(held, referenced=referenced)), None
    if state.adoption.done or gripper is None or _undecided(state, gripper):
        return state, None
    done = replace(state.adoption, done=True, remembered=None)
    if not gripper.holding or state.hands_off:
        return replace(state, adoption=done), None
    taken, message = _taken_over(state, gripper, observation, params)
    grip = replace(taken.grip, delay=state.grip.delay)
    motion = replace(state.arm, start_mm=taken.arm.start_mm)
    return replace(state, grip=grip, arm=motion, adoption=done), message


def _taken_over(
    state: GraspState, gripper: GripperState, observation: Observation, params: GuardParams
) -> tuple[GraspState, Message]:
    """Return the state that guards what the gripper holds, and the message about it."""
    before, force = state.adoption.remembered, force_text(gripper, gripper.force_n)
    state = state.taken_over(gripper, observation.now_s)
    force_range = force_limits.present_range(params, observation)
    if before is not None and not before.applied and before.fits(gripper) and force_range is not None:
        known_n = force_range.allowed(before.force_n, state.grip.target_n)
        if known_n > state.grip.target_n:
            message = Text.TAKEN_OVER_AND_REPEATED.message(force=force, known_n=known_n)
            return state.with_target(known_n, observation.now_s), message
    known_n = state.grip.target_n
    if known_n > gripper.force_n:
        return state, Text.TAKEN_OVER_WITH_KNOWN_FORCE.message(force=force, known_n=known_n)
    return state, Text.TAKEN_OVER.message(force=force)


_PHASES: dict[Phase, Callable[[GraspState, Observation, GuardParams], Result]] = {
    Phase.IDLE: _idle,
    Phase.CLOSING: _closing,
    Phase.REFERENCE: _reference,
    Phase.LIFTING: _moving,
    Phase.HOLDING: _holding,
    Phase.LOWERING: _moving,
    Phase.RELEASED: _released,
    Phase.FAULT: _fault,
}
