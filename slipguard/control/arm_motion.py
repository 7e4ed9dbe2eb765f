"""What the arm is told while an object is held: to stand, and to put down what no force of the budget can hold.

Putting down is for lift mode with `on_budget_spent = "lower"`: back along the path just lifted, slowly, no further than
where it began. The fault stays latched; anything else that goes wrong on the way stops the arm for good.
"""

from __future__ import annotations

from dataclasses import replace

from slipguard.control.fault import FaultCode
from slipguard.control.messages import ArmLift, Command, Observation, in_one_line
from slipguard.control.params import GuardParams
from slipguard.control.state import GraspState
from slipguard.devices import ArmState

REPEAT_S = 0.1
"""A command that had no effect is given again after this time."""
START_S = 0.25
"""An arm at rest this long after it was told to move has ended its motion, or not taken it up."""
FRESH_S = 0.1
"""What an arm said longer ago is no reason to move it; it is asked every 25 ms."""
REACHED_MM = 0.5
SPENT = frozenset({FaultCode.BUDGET_SPENT, FaultCode.TURNED_TOO_FAR})
"""Faults with all the force of the budget applied, and the object slipping on."""
SAME_SLIP = SPENT | {FaultCode.NO_HELP}
"""What may still be said of the same slip while the object is put down."""

Outcome = tuple[GraspState, Command]


def stop(state: GraspState, observation: Observation, command: Command, *, at_once: bool = False) -> Outcome:
    """Stop the arm, again and again until it says that it stands."""
    stands = observation.arm is not None and not observation.arm.moving
    if at_once or (not stands and observation.now_s - state.arm_sent_s >= REPEAT_S):
        return replace(state, arm_sent_s=observation.now_s), replace(command, arm="stop")
    return state, command


def brake(state: GraspState, observation: Observation, command: Command) -> Outcome:
    """Stop an arm that is to stand before the jaws open, until it has once said that it does; then it is free."""
    arm = observation.arm
    known = (
        arm is not None and arm.measured_at_s > state.arm_sent_s and observation.now_s - arm.measured_at_s <= FRESH_S
    )
    if arm is not None and known and not arm.moving:
        return (replace(state, braking=False) if state.braking else state), command
    if not state.braking or observation.now_s - state.arm_sent_s < REPEAT_S:
        return state, command
    return replace(state, arm_sent_s=observation.now_s), replace(command, arm="stop")


def ended(state: GraspState, arm: ArmState, now_s: float) -> bool:
    """The arm rests, as it has said just now, and has had the time to take up what it was told last."""
    known = arm.measured_at_s > state.arm_sent_s and now_s - arm.measured_at_s <= FRESH_S
    return known and not arm.moving and now_s - state.arm_sent_s >= START_S


def put_down(latched: Outcome, observation: Observation, params: GuardParams) -> Outcome:
    """The way down of an object whose fault has just been latched; as it was where the arm is to stand."""
    state, command = latched
    spent = state.fault is not None and state.fault.code in SPENT
    if not spent or params.on_force_limit != "lower" or params.mode != "lift" or state.person_near:
        return state, command
    if observation.arm is None or state.ground_mm is None:
        said = "it is not put down: it is not known where the lift began"
        return state, replace(command, say=in_one_line(command.say, said))
    way_mm = state.ground_mm - observation.arm.height_mm
    if way_mm > -REACHED_MM:
        return state, command
    state = replace(state, putting_down=True, goal_mm=state.ground_mm, arm_sent_s=observation.now_s)
    said = f"putting it down by {-way_mm:.0f} mm"
    return state, replace(command, arm=_leg(way_mm, params), say=in_one_line(command.say, said))


def go_on_down(state: GraspState, observation: Observation, command: Command, params: GuardParams) -> Outcome:
    """One tick on the way down."""
    arm, goal_mm = observation.arm, state.goal_mm
    other = any(fault.code not in SAME_SLIP for fault in (observation.fault, *observation.also) if fault is not None)
    if arm is None or goal_mm is None or state.person_near or other:
        why = "not put down any further"
        return stop(
            replace(state, putting_down=False),
            observation,
            replace(command, say=in_one_line(command.say, why)),
            at_once=True,
        )
    if not ended(state, arm, observation.now_s):
        return state, command
    way_mm = goal_mm - arm.height_mm
    if way_mm > -REACHED_MM:
        said = "put down where the lift began; release lets go"
        return replace(state, putting_down=False), replace(command, say=in_one_line(command.say, said))
    return replace(state, arm_sent_s=observation.now_s), replace(command, arm=_leg(way_mm, params))


def _leg(way_mm: float, params: GuardParams) -> ArmLift:
    return ArmLift(way_mm, min(params.tuning.probe_speed_mm_s, params.tuning.lower_speed_mm_s))
