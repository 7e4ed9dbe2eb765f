"""What people and other programs may ask for, and in which phase; a refusal is one line that says why.

Releasing is not here: it is granted in every phase, before anything else is looked at.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

from slipguard.control import force_limits as limits
from slipguard.control.fault import FaultCode
from slipguard.control.messages import ArmLift, Command, Observation, RequestKind, in_one_line
from slipguard.control.params import GuardParams
from slipguard.control.slip_baselines import SlipMemory
from slipguard.control.state import GraspState, Phase, emptied, entered, gripper_at_rest, taken_over

MAY_LAST = frozenset({FaultCode.ESTIMATE_UNTRUSTED})
"""Faults that only a clear can end: it takes a new reference, and what still cannot be told then latches again."""
INTERRUPTED = "the closing was interrupted and the jaws apply 0 N"

Outcome = tuple[GraspState, Command]


def answer(state: GraspState, command: Command, observation: Observation, params: GuardParams) -> Outcome:
    """Grant or refuse this tick's request, on top of what the phase has commanded already."""
    granted = _ANSWERS.get(observation.request.kind)
    if granted is None:
        return state, command
    state, answered = granted(state, command, observation, params)
    if answered.say != command.say:
        answered = replace(answered, say=in_one_line(command.say, answered.say))
    return state, answered


def next_leg(state: GraspState, height_mm: float, params: GuardParams) -> ArmLift:
    """The next piece of the way to the goal: the first `probe_height_mm` of a lift slowly, the rest in one."""
    goal_mm = state.goal_mm if state.goal_mm is not None else height_mm
    way_mm = goal_mm - height_mm
    if state.phase is Phase.LOWERING:
        return ArmLift(way_mm, state.lift_speed_mm_s or params.tuning.lower_speed_mm_s)
    speed_mm_s = state.lift_speed_mm_s or params.lift_speed_mm_s
    ground_mm = state.ground_mm if state.ground_mm is not None else height_mm
    probe_mm = ground_mm + params.tuning.probe_height_mm - height_mm
    if probe_mm > 0.5 and way_mm > probe_mm:
        return ArmLift(probe_mm, min(params.tuning.probe_speed_mm_s, speed_mm_s))
    if probe_mm > 0.5:
        return ArmLift(way_mm, min(params.tuning.probe_speed_mm_s, speed_mm_s))
    return ArmLift(way_mm, speed_mm_s)


def _refuse(state: GraspState, command: Command, why: str) -> Outcome:
    return state, replace(command, refused=why)


def _grasp(state: GraspState, command: Command, observation: Observation, params: GuardParams) -> Outcome:
    if state.phase is not Phase.IDLE:
        why = _latched(state) or f"cannot grasp while {state.phase}; release first"
        return _refuse(state, command, why)
    if observation.gripper is None:
        return _refuse(state, command, "the gripper is not there; see its health in `slipguard ctl state`")
    if observation.gripper.fault is not None or not observation.gripper.active:
        return _refuse(state, command, f"the gripper is not ready ({observation.gripper.fault or 'not activated'})")
    if observation.gripper.holding and not state.closing_interrupted:
        return _refuse(state, command, "something is held already; `guard on` guards it, `release` lets it go")
    if state.person_near:
        return _refuse(state, command, "the arm is in a protective or emergency stop; end that first")
    within = limits.budget(params.force_max_n, observation.gripper_limits_n)
    if within is None:
        weakest = f"force_max_n = {params.force_max_n:g} N is below the {observation.gripper_limits_n[0]:g} N"
        return _refuse(state, command, f"{weakest} this gripper applies at least")
    wanted_n = observation.request.force_n if observation.request.force_n is not None else limits.first_n(params)
    if wanted_n > params.force_max_n:
        return _refuse(state, command, f"{wanted_n:g} N is above force_max_n = {params.force_max_n:g} N")
    force_n = limits.allowed(wanted_n, 0.0, within)
    state = replace(emptied(state, Phase.CLOSING, observation.now_s), target_n=force_n, commanded_s=observation.now_s)
    return state, replace(command, hold_force_n=force_n, say=f"closing with {force_n:.0f} N")


def _lift(state: GraspState, command: Command, observation: Observation, params: GuardParams) -> Outcome:
    why = _no_motion(state, observation, params, "lift")
    if why is None and state.guarding and state.blind is not None and params.on_no_estimate == "refuse":
        why = f"the turn cannot be seen ({state.blind}); grip it elsewhere, or set on_blind = 'grip'"
    if why is not None or observation.arm is None:
        return _refuse(state, command, why or "")
    height_mm = observation.request.height_mm if observation.request.height_mm is not None else params.lift_height_mm
    here_mm = observation.arm.height_mm
    state = replace(
        entered(state, Phase.LIFTING, observation.now_s),
        ground_mm=here_mm if state.ground_mm is None else state.ground_mm,
        goal_mm=here_mm + height_mm,
        lift_speed_mm_s=observation.request.speed_mm_s,
        arm_sent_s=observation.now_s,
    )
    leg = next_leg(state, here_mm, params)
    return state, replace(command, arm=leg, say=f"lifting by {height_mm:g} mm")


def _lower(state: GraspState, command: Command, observation: Observation, params: GuardParams) -> Outcome:
    why = _no_motion(state, observation, params, "lower")
    if why is None and state.ground_mm is None and observation.request.height_mm is None:
        why = "the way down is not known (no lift since it was gripped, or the arm was away); give a height"
    if why is not None or observation.arm is None:
        return _refuse(state, command, why or "")
    here_mm = observation.arm.height_mm
    if observation.request.height_mm is not None:
        goal_mm = here_mm - observation.request.height_mm
    else:
        goal_mm = state.ground_mm if state.ground_mm is not None else here_mm
    state = replace(
        entered(state, Phase.LOWERING, observation.now_s),
        goal_mm=goal_mm,
        lift_speed_mm_s=observation.request.speed_mm_s,
        arm_sent_s=observation.now_s,
    )
    leg = next_leg(state, here_mm, params)
    return state, replace(command, arm=leg, say=f"lowering by {here_mm - goal_mm:.0f} mm")


def _latched(state: GraspState) -> str | None:
    """What comes before any command but a release: the fault, if there is one."""
    if state.phase is not Phase.FAULT or state.fault is None:
        return None
    return f"a fault is latched ({state.fault.code}); clear it first"


def _no_motion(state: GraspState, observation: Observation, params: GuardParams, verb: str) -> str | None:
    """Why slipguard may not move the arm now; None if it may."""
    if params.mode == "guard":
        return f"cannot {verb}: in guard mode the arm belongs to another program"
    if state.phase is not Phase.HOLDING:
        return _latched(state) or f"cannot {verb} while {state.phase}; grasp and wait for 'holding'"
    if state.slip is not None:
        return f"cannot {verb}: the object is slipping; wait until it is calm"
    if observation.gripper is None or not gripper_at_rest(state, observation.gripper):
        return f"cannot {verb}: the grip is not yet firm; ask again in a moment"
    if observation.arm is None:
        return f"cannot {verb}: the arm is not there; see its health in `slipguard ctl state`"
    if state.person_near:
        return f"cannot {verb}: the arm is in a protective or emergency stop; end that first"
    return None


def _guard_on(state: GraspState, command: Command, observation: Observation, params: GuardParams) -> Outcome:
    state = replace(state, guarding=True)
    if state.phase is Phase.FAULT and state.hands_off:
        return _guard_again(state, command, observation)
    if state.phase is Phase.FAULT:
        return state, replace(command, say="guarding; the fault stays latched until it is cleared")
    if state.phase is not Phase.IDLE:
        return state, replace(command, say="guarding")
    if observation.gripper is None or not observation.gripper.holding:
        if params.mode == "guard":
            return state, replace(command, say="will guard what is gripped")
        return _refuse(state, command, "nothing is held; grasp something first")
    if state.closing_interrupted and observation.gripper.force_n <= 0.0:
        return _refuse(state, command, f"{INTERRUPTED}; grasp again, or release")
    said = f"guarding what is held with {observation.gripper.force_n:.0f} N"
    return taken_over(state, observation.gripper, observation.now_s), replace(command, new_reference=True, say=said)


def _guard_again(state: GraspState, command: Command, observation: Observation) -> Outcome:
    """In a fault, guard an object after a release request or an interrupted closing. The fault stays latched.

    An interrupted closing counts as a grip only if the gripper reports a force; the force target never falls.
    """
    if observation.gripper is None or not observation.gripper.holding:
        return _refuse(state, command, "nothing is held; clear, then grasp something first")
    force_n = observation.gripper.force_n
    if state.closing_interrupted and force_n <= 0.0:
        return _refuse(state, command, f"{INTERRUPTED}; clear and grasp again, or release")
    state = replace(
        state,
        release_requested=False,
        closing_interrupted=False,
        gripped=True,
        target_n=max(state.target_n, force_n),
        commanded_s=-math.inf,
        detector=SlipMemory(),
    )
    return state, replace(command, new_reference=True, say=f"guarding what is held with {force_n:.0f} N")


def _guard_off(state: GraspState, command: Command, observation: Observation, params: GuardParams) -> Outcome:
    if (why := _latched(state)) is not None:
        return _refuse(state, command, why)
    state = replace(state, guarding=False, slip=None, detector=SlipMemory())
    return state, replace(command, say="not guarding: slip is not acted on")


def _gripper(state: GraspState, command: Command, observation: Observation, params: GuardParams) -> Outcome:
    """Another program's grip: granted empty-handed; with an object held only ever tighter."""
    request, gripper = observation.request, observation.gripper
    if request.width_mm is None and request.force_n is None:
        return _refuse(state, command, "say what the jaws shall do: give a width, a force or both")
    force_n = request.force_n if request.force_n is not None else params.first_force_n
    within = limits.budget(params.force_max_n, observation.gripper_limits_n)
    if gripper is None:
        return _refuse(state, command, "the gripper is not there; see its health in `slipguard ctl state`")
    if gripper.fault is not None or not gripper.active:
        return _refuse(state, command, f"the gripper is not ready ({gripper.fault or 'not activated'})")
    if within is None or force_n > params.force_max_n:
        return _refuse(state, command, f"{force_n:g} N is not within force_max_n = {params.force_max_n:g} N")
    if state.person_near:
        return _refuse(state, command, "the arm is in a protective or emergency stop; end that first")
    if state.phase is Phase.IDLE and not gripper.holding:
        if request.width_mm is None:
            return _refuse(state, command, "nothing is held: give the width the jaws shall move to")
        force_n = limits.allowed(force_n, 0.0, within)
        said = f"moving the jaws to {request.width_mm:g} mm with {force_n:.0f} N"
        if request.width_mm < gripper.width_mm:
            said += _nobody_guards(state, params)
        return state, replace(command, move_width_mm=request.width_mm, move_force_n=force_n, say=said)
    if state.phase in (Phase.CLOSING, Phase.RELEASED, Phase.FAULT):
        return _refuse(state, command, _latched(state) or f"cannot move the jaws while {state.phase}")
    if request.width_mm is not None and request.width_mm > gripper.width_mm:
        return _refuse(state, command, "an object is held and opening would drop it; use release")
    target_n = limits.allowed(force_n, max(state.target_n, gripper.force_n), within)
    said = f"holding with {target_n:.0f} N, as asked"
    if state.phase is Phase.IDLE:
        return state, replace(command, hold_force_n=target_n, say=said + _nobody_guards(state, params))
    state = replace(state, target_n=target_n, commanded_s=observation.now_s)
    return state, replace(command, hold_force_n=target_n, say=said)


def _nobody_guards(state: GraspState, params: GuardParams) -> str:
    """In guard mode what the jaws meet is guarded by itself; in lift mode it may be anything."""
    by_itself = params.mode == "guard" and state.guarding
    return "" if by_itself else "; what they grip is not guarded until `guard on`"


def _clear(state: GraspState, command: Command, observation: Observation, params: GuardParams) -> Outcome:
    """Out of FAULT, into the phase that fits what the gripper holds."""
    if state.phase is not Phase.FAULT:
        return _refuse(state, command, "no fault is latched")
    if state.putting_down:
        return _refuse(state, command, "the object is being put down; clear when the arm stands, or release")
    lasting = [
        fault for fault in (observation.fault, *observation.also) if fault is not None and fault.code not in MAY_LAST
    ]
    if lasting:
        return _refuse(state, command, f"the cause is still there: {lasting[0]}")
    if observation.gripper is None:
        return _refuse(state, command, "the gripper is not there, so it is not known what it holds")
    if state.person_near:
        return _refuse(state, command, "the arm is in a protective or emergency stop; end that first")
    if observation.gripper.moving and not observation.gripper.holding:
        return _refuse(state, command, "the gripper is moving, so it is not known what it will hold; ask again")
    if not observation.gripper.holding:
        return emptied(state, Phase.IDLE, observation.now_s), replace(command, say="cleared; nothing is held")
    if state.closing_interrupted:
        said = "cleared; the closing was cut short: grasp again, or release"
        return replace(emptied(state, Phase.IDLE, observation.now_s), closing_interrupted=True), replace(
            command, say=said
        )
    ground_mm, target_n = state.ground_mm, max(state.target_n, observation.gripper.force_n)
    commanded_s = state.commanded_s
    state = taken_over(state, observation.gripper, observation.now_s)
    state = replace(state, ground_mm=ground_mm, target_n=target_n, commanded_s=commanded_s)
    said = f"cleared; holding with {target_n:.0f} N"
    return state, replace(command, new_reference=True, say=said)


_ANSWERS: dict[RequestKind, Callable[[GraspState, Command, Observation, GuardParams], Outcome]] = {
    RequestKind.GRASP: _grasp,
    RequestKind.LIFT: _lift,
    RequestKind.LOWER: _lower,
    RequestKind.GUARD_ON: _guard_on,
    RequestKind.GUARD_OFF: _guard_off,
    RequestKind.GRIPPER: _gripper,
    RequestKind.CLEAR: _clear,
}
