"""What the arm is commanded while an object is held: legs of a lift, stops, and putting down at the force limit.

Putting down is for lift mode with `on_force_limit = "lower"`: back along the path just lifted, slowly, no further than
where it began. The fault stays latched; any other fault on the way stops the arm for good.
"""

from __future__ import annotations

import math
from dataclasses import replace

from slipguard.control.load_state import HANGS_MM, LoadState
from slipguard.control.messages import LiftArm, Observation, StepOutput, StopArm
from slipguard.control.params import GuardParams
from slipguard.control.reports import FaultCode, Text
from slipguard.control.state import GraspState, Phase
from slipguard.devices import ArmState

REPEAT_S = 0.1
"""A command without effect is repeated after this time."""
START_S = 0.25
"""An arm at rest this long after a command has ended its motion, or has not begun it."""
FRESH_S = 0.1
"""An older state is no reason to move the arm; it is read every 25 ms."""
REACHED_MM = 0.5
LIFT_OFF_DEG_S, LEAST_MM_S = 2.0, 1.0
"""While an object leaves the table, the arm rotates it no faster than this, and goes no slower than this."""
SPEED_UP = 1.5
"""A lift under way is commanded again only for a speed above this multiple of the present one."""
ABOVE_MM = 5.0
"""An arm that is no further than this from straight above the start of the lift can go back down to it."""
AT_LIMIT = frozenset({FaultCode.FORCE_LIMIT_REACHED, FaultCode.ROTATED_TOO_FAR})
"""Faults at the force limit, with the object still slipping."""
SAME_SLIP = AT_LIMIT | {FaultCode.TIGHTENING_INEFFECTIVE}
"""Faults that the same slip may still raise while the object is put down."""

Result = tuple[GraspState, StepOutput]


def stop(state: GraspState, observation: Observation, output: StepOutput, *, at_once: bool = False) -> Result:
    """Stop the arm, and repeat it until the arm reports that it stands."""
    stands = observation.arm is not None and not observation.arm.moving
    if at_once or (not stands and observation.now_s - state.arm.commanded_s >= REPEAT_S):
        return _commanded(state, observation), replace(output, arm=StopArm())
    return state, output


def follow_start(state: GraspState, arm: ArmState) -> GraspState:
    """Return the state with the height where the lift began, while the arm is above that position.

    The height counts from where the arm was connected, so after a restart it follows from the stored position. An arm
    that reports no position is not followed.
    """
    start_mm, here_mm, ground_mm = state.arm.start_mm, arm.position_mm, state.arm.ground_mm
    if start_mm is None or here_mm is None:
        return state
    above = math.dist(start_mm[:2], here_mm[:2]) <= ABOVE_MM
    if above is (ground_mm is not None):
        return state
    ground_mm = arm.height_mm - (here_mm[2] - start_mm[2]) if above else None
    return replace(state, arm=replace(state.arm, ground_mm=ground_mm))


def is_current(state: GraspState, arm: ArmState, now_s: float) -> bool:
    """Return whether the arm's state is recent, and newer than the last command to it."""
    return arm.measured_at_s > state.arm.commanded_s and now_s - arm.measured_at_s <= FRESH_S


def has_ended(state: GraspState, arm: ArmState, now_s: float) -> bool:
    """Return whether the arm certainly rests, and had the time to begin what it was last commanded."""
    return is_current(state, arm, now_s) and not arm.moving and now_s - state.arm.commanded_s >= START_S


def next_leg(state: GraspState, arm: ArmState, params: GuardParams) -> LiftArm:
    """Return the next leg to the goal: slowly until the object hangs, so that no load arrives faster than the grip.

    An object that rotates with the arm, its far end on the table, is raised at `LIFT_OFF_DEG_S`.
    """
    goal_mm = state.arm.goal_mm if state.arm.goal_mm is not None else arm.height_mm
    way_mm, tuning = goal_mm - arm.height_mm, params.tuning
    if state.phase is Phase.LOWERING:
        return LiftArm(way_mm, state.arm.speed_mm_s or tuning.lower_speed_mm_s)
    speed_mm_s = state.arm.speed_mm_s or params.lift_speed_mm_s
    load, ground_mm = state.held.load, state.arm.ground_mm
    if load.hangs or not state.guarding:
        return LiftArm(way_mm, speed_mm_s)
    risen_mm, rate_deg_s = arm.height_mm - (ground_mm or 0.0), abs(load.motion.rate[0])
    if arm.moving and risen_mm >= HANGS_MM:
        slow_mm_s = LIFT_OFF_DEG_S / max(rate_deg_s, 1.0) * arm.speed_mm_s
    else:
        turned_deg = max(abs(load.motion.position[0]), 1e-3)
        slow_mm_s = min(tuning.lift_off_speed_mm_s, LIFT_OFF_DEG_S * max(risen_mm, 1.0) / turned_deg)
    return LiftArm(way_mm, min(max(slow_mm_s, LEAST_MM_S), speed_mm_s))


def may_speed_up(state: GraspState, arm: ArmState, now_s: float, leg: LiftArm) -> bool:
    """Return whether a lift under way is much slower than the next leg may be."""
    lifts = state.phase is Phase.LIFTING and arm.moving and now_s - state.arm.commanded_s >= START_S
    return lifts and is_current(state, arm, now_s) and leg.speed_mm_s > SPEED_UP * arm.speed_mm_s


def put_down(latched: Result, observation: Observation, params: GuardParams) -> Result:
    """Begin to put down the object of a fault that has just been latched; or leave the arm stopped."""
    state, output = latched
    at_limit = state.fault is not None and state.fault.code in AT_LIMIT
    if not at_limit or params.on_force_limit != "lower" or params.mode != "lift" or state.person.now:
        return state, output
    if state.stop is not None:
        return state, output.with_messages(Text.NOT_PUT_DOWN_AFTER_STOP.message())
    arm, ground_mm = observation.arm, state.arm.ground_mm
    if arm is None or ground_mm is None:
        return state, output.with_messages(Text.NO_WAY_DOWN.message())
    way_mm = ground_mm - arm.height_mm
    if way_mm > -REACHED_MM:
        return state, output
    motion = replace(state.arm, putting_down=True, goal_mm=ground_mm, commanded_s=observation.now_s)
    if observation.now_s - arm.measured_at_s <= FRESH_S:  # otherwise stop, and go down from the height reported then
        output = replace(output, arm=_leg_down(way_mm, params))
    return replace(state, arm=motion), output.with_messages(Text.PUTTING_DOWN.message(height_mm=-way_mm))


def continue_down(state: GraspState, observation: Observation, output: StepOutput, params: GuardParams) -> Result:
    """Go on putting the object down, for one step."""
    arm, goal_mm = observation.arm, state.arm.goal_mm
    other = any(fault.code not in SAME_SLIP for fault in observation.faults)
    done = replace(state, arm=replace(state.arm, putting_down=False))
    if arm is None or goal_mm is None or state.person.now or other:
        return stop(done, observation, output.with_messages(Text.PUT_DOWN_STOPPED.message()), at_once=True)
    if not has_ended(state, arm, observation.now_s):
        return state, output
    way_mm = goal_mm - arm.height_mm
    if way_mm > -REACHED_MM:
        held = replace(done.held, load=LoadState(), slip=None)  # it lies as it lies: that is the new rest
        return replace(done, held=held), output.with_messages(Text.PUT_DOWN.message())
    return _commanded(state, observation), replace(output, arm=_leg_down(way_mm, params))


def _leg_down(way_mm: float, params: GuardParams) -> LiftArm:
    return LiftArm(way_mm, params.tuning.lower_speed_mm_s)


def _commanded(state: GraspState, observation: Observation) -> GraspState:
    return replace(state, arm=replace(state.arm, commanded_s=observation.now_s))
