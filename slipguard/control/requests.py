"""Grant or refuse what people and other programs request, by phase. A refusal is one message with the reason.

Release and stop are not here: they are granted in every phase.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

from slipguard.control import arm_motion, force_limits
from slipguard.control.arm_motion import Result
from slipguard.control.load_state import LoadState
from slipguard.control.messages import ActivateGripper, HoldForce, MoveJaws, Observation, RequestKind, StepOutput
from slipguard.control.params import GuardParams
from slipguard.control.reports import FaultCode, Message, Text
from slipguard.control.state import GraspState, HandsOff, Phase, force_text, gripper_at_rest
from slipguard.devices import ACTIVATION_HINT, ArmState, GripperState
from slipguard.mounting import TILT_MAX_DEG, mounting_name, tilt_deg

CLEAR_ENDS = frozenset({FaultCode.ESTIMATE_UNTRUSTED})
"""Faults whose cause may persist at a clear: it takes a new reference, and without an estimate they latch again."""


def handle_request(state: GraspState, output: StepOutput, observation: Observation, params: GuardParams) -> Result:
    """Grant or refuse the request of this step, on top of what the phase has commanded already."""
    handle = _HANDLERS.get(observation.request.kind)
    return (state, output) if handle is None else handle(state, output, observation, params)


def _refuse(state: GraspState, output: StepOutput, why: Message) -> Result:
    return state, replace(output, refusal=why)


def _latched(state: GraspState) -> Message | None:
    """Return the refusal while a fault is latched."""
    if state.phase is not Phase.FAULT or state.fault is None:
        return None
    return Text.FAULT_LATCHED.message(code=state.fault.code)


def _gripper_unfit(gripper: GripperState | None) -> Message | None:
    """Return why the gripper cannot be commanded."""
    if gripper is None:
        return Text.GRIPPER_MISSING.message()
    if gripper.fault is not None or not gripper.active:
        return Text.GRIPPER_NOT_READY.message(why=gripper.fault or f"not activated; {ACTIVATION_HINT}")
    return None


def _grasp(state: GraspState, output: StepOutput, observation: Observation, params: GuardParams) -> Result:
    if state.phase is not Phase.IDLE:
        busy = Text.NOT_IN_PHASE.message(verb="grasp", phase=state.phase, hint="support the object, then release it")
        return _refuse(state, output, _latched(state) or busy)
    gripper, requested_limit_n = observation.gripper, observation.request.force_limit_n
    if (why := _gripper_unfit(gripper)) is not None:
        return _refuse(state, output, why)
    if requested_limit_n is not None and requested_limit_n > params.force_max_n:
        why = Text.ABOVE_FORCE_LIMIT.message(force_n=requested_limit_n, limit_n=params.force_max_n)
        return _refuse(state, output, why)
    params = params.limited(requested_limit_n)
    limit_n = params.force_max_n
    if gripper is not None and gripper.holding and not state.hands_off.closing_interrupted:
        return _refuse(state, output, Text.ALREADY_HELD.message())
    if state.person.now:
        return _refuse(state, output, Text.ARM_STOPPED.message(verb="grasp"))
    force_range = force_limits.force_range(limit_n, observation.gripper_limits_n)
    if force_range is None:
        weakest_n = observation.gripper_limits_n[0]
        return _refuse(state, output, Text.LIMIT_BELOW_GRIPPER.message(limit_n=limit_n, weakest_n=weakest_n))
    requested_n = observation.request.force_n
    force_n = requested_n if requested_n is not None else force_limits.first_n(params)
    if force_n > limit_n:
        return _refuse(state, output, Text.ABOVE_FORCE_LIMIT.message(force_n=force_n, limit_n=limit_n))
    force_n = force_range.allowed(force_n, 0.0)
    state = state.emptied(Phase.CLOSING, observation.now_s).with_target(force_n, observation.now_s)
    state = replace(state, grip=replace(state.grip, limit_n=requested_limit_n))
    return state, replace(output, gripper=HoldForce(force_n)).with_messages(Text.CLOSING.message(force_n=force_n))


def _no_motion(state: GraspState, observation: Observation, params: GuardParams, verb: str) -> Message | None:
    """Return why slipguard must not move the arm now."""
    if params.mode == "guard":
        return Text.NOT_IN_GUARD_MODE.message(verb=verb)
    if state.phase is not Phase.HOLDING:
        hint = "grasp and wait for 'holding'"
        return _latched(state) or Text.NOT_IN_PHASE.message(verb=verb, phase=state.phase, hint=hint)
    if state.held.slip is not None:
        return Text.NOT_WHILE_SLIPPING.message(verb=verb)
    if observation.gripper is None or not gripper_at_rest(state, observation.gripper):
        return Text.GRIP_NOT_FIRM.message(verb=verb)
    if observation.arm is None:
        return Text.ARM_MISSING.message(verb=verb)
    if state.person.now:
        return Text.ARM_STOPPED.message(verb=verb)
    if (why := _not_upright(observation.arm, verb)) is not None:
        return why
    age_s = observation.now_s - observation.arm.measured_at_s
    if age_s > arm_motion.FRESH_S:  # the first leg counts from this height
        return Text.ARM_STATE_OLD.message(verb=verb, age_ms=1000.0 * age_s, limit_ms=1000.0 * arm_motion.FRESH_S)
    return None


def _not_upright(arm: ArmState, verb: str) -> Message | None:
    """Return the refusal for an arm that is not mounted upright; None if it is, or if it cannot measure that."""
    if arm.up is None or (tilt := tilt_deg(arm.up)) <= TILT_MAX_DEG:
        return None
    return Text.NOT_UPRIGHT.message(verb=verb, how=mounting_name(tilt), tilt_deg=tilt, limit_deg=TILT_MAX_DEG)


def _lift(state: GraspState, output: StepOutput, observation: Observation, params: GuardParams) -> Result:
    why, reason = _no_motion(state, observation, params, "lift"), state.held.no_estimate
    if why is None and state.guarding and reason is not None and params.on_no_estimate == "refuse":
        why = Text.NO_ESTIMATE_REFUSED.message(why=reason)
    arm = observation.arm
    if why is not None or arm is None:
        return _refuse(state, output, why or Text.ARM_MISSING.message(verb="lift"))
    requested_mm = observation.request.height_mm
    height_mm = requested_mm if requested_mm is not None else params.lift_height_mm
    message = Text.LIFTING.message(height_mm=height_mm)
    if state.arm.ground_mm is None:
        motion = replace(state.arm, ground_mm=arm.height_mm, start_mm=arm.position_mm)
        state = replace(state, arm=motion)
    return _start(state, Phase.LIFTING, arm.height_mm + height_mm, arm, observation, params, output, message)


def _lower(state: GraspState, output: StepOutput, observation: Observation, params: GuardParams) -> Result:
    why, requested_mm = _no_motion(state, observation, params, "lower"), observation.request.height_mm
    ground_mm, arm = state.arm.ground_mm, observation.arm
    if why is None and ground_mm is None and requested_mm is None:
        why = Text.WAY_DOWN_UNKNOWN.message()
    if why is not None or arm is None:
        return _refuse(state, output, why or Text.ARM_MISSING.message(verb="lower"))
    goal_mm = ground_mm if requested_mm is None and ground_mm is not None else arm.height_mm - (requested_mm or 0.0)
    message = Text.LOWERING.message(height_mm=arm.height_mm - goal_mm)
    return _start(state, Phase.LOWERING, goal_mm, arm, observation, params, output, message)


def _start(
    state: GraspState,
    phase: Phase,
    goal_mm: float,
    arm: ArmState,
    observation: Observation,
    params: GuardParams,
    output: StepOutput,
    message: Message,
) -> Result:
    """Begin a lift or lowering with its first leg."""
    state = state.entered(phase, observation.now_s)
    speed_mm_s = observation.request.speed_mm_s
    motion = replace(state.arm, goal_mm=goal_mm, speed_mm_s=speed_mm_s, commanded_s=observation.now_s)
    state = replace(state, arm=motion, stop=None)
    leg = arm_motion.next_leg(state, arm, params)
    return state, replace(output, arm=leg).with_messages(message)


def _guard_on(state: GraspState, output: StepOutput, observation: Observation, params: GuardParams) -> Result:
    person = replace(state.person, after_stop=False)
    state, gripper = replace(state, guarding=True, person=person), observation.gripper
    if state.phase is Phase.FAULT and state.hands_off:
        return _guard_in_fault(state, output, gripper)
    if state.phase is Phase.FAULT:
        return state, output.with_messages(Text.GUARDING_IN_FAULT.message())
    if state.phase is not Phase.IDLE:
        return state, output.with_messages(Text.GUARDING.message())
    if gripper is None or not gripper.holding:
        if params.mode == "guard":
            return state, output.with_messages(Text.WILL_GUARD.message())
        return _refuse(state, output, Text.NOTHING_HELD.message())
    if state.hands_off.closing_interrupted and gripper.force_n <= 0.0:
        return _refuse(state, output, Text.INTERRUPTED.message())
    message = Text.GUARDING_HELD.message(force=force_text(gripper, gripper.force_n))
    state = state.taken_over(gripper, observation.now_s)
    return state, replace(output, new_reference=True).with_messages(message)


def _guard_in_fault(state: GraspState, output: StepOutput, gripper: GripperState | None) -> Result:
    """Guard an object after a release request or an interrupted closing. The fault stays latched.

    An interrupted closing counts as a grip only if the gripper reports a force; the force target never falls.
    """
    if gripper is None or not gripper.holding:
        return _refuse(state, output, Text.NOTHING_HELD_IN_FAULT.message())
    if state.hands_off.closing_interrupted and gripper.force_n <= 0.0:
        return _refuse(state, output, Text.INTERRUPTED_IN_FAULT.message())
    target_n = max(state.grip.target_n, gripper.force_n)
    grip = replace(state.grip, target_n=target_n, commanded_s=-math.inf, closed=True)
    held = replace(state.held, load=LoadState())
    message = Text.GUARDING_HELD.message(force=force_text(gripper, gripper.force_n))
    state = replace(state, grip=grip, held=held).with_jaws_requested()
    return state, replace(output, new_reference=True).with_messages(message)


def _guard_off(state: GraspState, output: StepOutput, observation: Observation, params: GuardParams) -> Result:
    if (why := _latched(state)) is not None:
        return _refuse(state, output, why)
    held = replace(state.held, load=LoadState(), slip=None)
    return replace(state, guarding=False, held=held), output.with_messages(Text.NOT_GUARDING.message())


def _gripper(state: GraspState, output: StepOutput, observation: Observation, params: GuardParams) -> Result:
    """Grant another program's grip if nothing is held; with an object held only a tighter one."""
    request, gripper, limit_n = observation.request, observation.gripper, params.force_max_n
    if request.width_mm is None and request.force_n is None:
        return _refuse(state, output, Text.GIVE_WIDTH_OR_FORCE.message())
    force_n = request.force_n if request.force_n is not None else params.first_force_n
    force_range = force_limits.force_range(limit_n, observation.gripper_limits_n)
    why = _gripper_unfit(gripper)
    if why is not None or gripper is None:
        return _refuse(state, output, why or Text.GRIPPER_MISSING.message())
    if force_range is None or force_n > limit_n:
        return _refuse(state, output, Text.NOT_WITHIN_FORCE_LIMIT.message(force_n=force_n, limit_n=limit_n))
    if state.person.now:
        return _refuse(state, output, Text.ARM_STOPPED.message(verb="move the jaws"))
    guarded = params.mode == "guard" and state.guarding  # then an object that the jaws meet is guarded by itself
    if state.phase is Phase.IDLE and not gripper.holding:
        if request.width_mm is None:
            return _refuse(state, output, Text.GIVE_WIDTH.message())
        force_n = force_range.allowed(force_n, 0.0)
        opens = request.width_mm >= gripper.width_mm
        text = Text.MOVING_JAWS if opens or guarded else Text.MOVING_JAWS_UNGUARDED
        output = replace(output, gripper=MoveJaws(request.width_mm, force_n))
        return state.with_jaws_requested(), output.with_messages(
            text.message(width_mm=request.width_mm, force_n=force_n)
        )
    if state.phase in (Phase.CLOSING, Phase.RELEASED, Phase.FAULT):
        busy = Text.NOT_IN_PHASE.message(verb="move the jaws", phase=state.phase, hint="wait until that has ended")
        return _refuse(state, output, _latched(state) or busy)
    if request.width_mm is not None and request.width_mm > gripper.width_mm:
        return _refuse(state, output, Text.WOULD_DROP.message())
    target_n = force_range.allowed(force_n, max(state.grip.target_n, gripper.force_n))
    output = replace(output, gripper=HoldForce(target_n))
    if state.phase is Phase.IDLE:
        text = Text.HOLDING_AS_REQUESTED if guarded else Text.HOLDING_UNGUARDED
        return state.with_jaws_requested(), output.with_messages(text.message(force_n=target_n))
    message = Text.HOLDING_AS_REQUESTED.message(force_n=target_n)
    return state.with_target(target_n, observation.now_s), output.with_messages(message)


def _is_empty_though_inactive(observation: Observation) -> bool:
    """Return whether a gripper without a fault only has to be activated: it was opened, or no finger sees contact."""
    gripper, fused = observation.gripper, observation.fused
    if gripper is None or gripper.active or gripper.fault is not None:
        return False
    return gripper.auto_released or (fused is not None and fused.left_contact is fused.right_contact is False)


def _clear(state: GraspState, output: StepOutput, observation: Observation, params: GuardParams) -> Result:
    """Leave FAULT for the phase that fits what the gripper holds.

    A gripper that is not active cannot say, and only leaves IDLE by an activation. So it counts as empty if no finger
    sees contact.
    """
    gripper, now_s = observation.gripper, observation.now_s
    if state.phase is not Phase.FAULT:
        return _refuse(state, output, Text.NO_FAULT.message())
    if state.arm.putting_down:
        return _refuse(state, output, Text.BEING_PUT_DOWN.message())
    inactive = _is_empty_though_inactive(observation)
    ends = CLEAR_ENDS | {FaultCode.GRIPPER_FAULT} if inactive else CLEAR_ENDS
    lasting = [fault for fault in observation.faults if fault.code not in ends]
    if lasting:
        return _refuse(state, output, Text.CAUSE_PERSISTS.message(fault=lasting[0]))
    if gripper is None:
        return _refuse(state, output, Text.HOLD_UNKNOWN.message())
    if state.person.now:
        return _refuse(state, output, Text.ARM_STOPPED.message(verb="clear"))
    if gripper.moving and not gripper.holding:
        return _refuse(state, output, Text.HOLD_UNKNOWN_YET.message())
    if not gripper.holding:
        text = Text.CLEARED_INACTIVE if inactive else Text.CLEARED_EMPTY
        return state.emptied(Phase.IDLE, now_s), output.with_messages(text.message(hint=ACTIVATION_HINT))
    if state.hands_off.closing_interrupted:
        state = replace(state.emptied(Phase.IDLE, now_s), hands_off=HandsOff(closing_interrupted=True))
        return state, output.with_messages(Text.CLEARED_INTERRUPTED.message())
    before, state = state, state.taken_over(gripper, now_s)
    target_n = max(before.grip.target_n, gripper.force_n)
    grip = replace(state.grip, target_n=target_n, commanded_s=before.grip.commanded_s)
    motion = replace(state.arm, ground_mm=before.arm.ground_mm, start_mm=before.arm.start_mm)
    held = replace(state.held, seen_by=before.held.seen_by)
    state = replace(state, grip=grip, arm=motion, held=held)
    message = Text.CLEARED_HOLDING.message(force=force_text(gripper, target_n))
    return state, replace(output, new_reference=True).with_messages(message)


def _activate(state: GraspState, output: StepOutput, observation: Observation, params: GuardParams) -> Result:
    """Grant the activation only if nothing may be held: it opens the jaws and closes them fully."""
    gripper = observation.gripper
    if gripper is None:
        return _refuse(state, output, Text.GRIPPER_MISSING.message())
    if gripper.active and gripper.fault is None:
        return _refuse(state, output, Text.ALREADY_ACTIVE.message())
    if state.phase is not Phase.IDLE:
        return _refuse(state, output, Text.MAY_HOLD.message(why=f"the phase is {state.phase}"))
    if gripper.holding or state.hands_off:
        return _refuse(state, output, Text.MAY_HOLD.message(why="the gripper reports a grip"))
    if state.person.now:
        return _refuse(state, output, Text.ARM_STOPPED.message(verb="activate"))
    return state, replace(output, gripper=ActivateGripper()).with_messages(Text.ACTIVATING.message())


_HANDLERS: dict[RequestKind, Callable[[GraspState, StepOutput, Observation, GuardParams], Result]] = {
    RequestKind.GRASP: _grasp,
    RequestKind.LIFT: _lift,
    RequestKind.LOWER: _lower,
    RequestKind.GUARD_ON: _guard_on,
    RequestKind.GUARD_OFF: _guard_off,
    RequestKind.GRIPPER: _gripper,
    RequestKind.CLEAR: _clear,
    RequestKind.ACTIVATE: _activate,
}
