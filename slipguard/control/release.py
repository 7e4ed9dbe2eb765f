"""Letting go, on request: the arm is stopped first, for a moving arm throws; then the jaws open.

What was asked to be let go is left alone from then on: nothing tightens or guards it until a person says otherwise.
"""

from __future__ import annotations

import math
from dataclasses import replace

from slipguard.control import arm_motion as motion
from slipguard.control.arm_motion import REPEAT_S
from slipguard.control.fault import Fault, FaultCode
from slipguard.control.messages import Command, Observation, in_one_line
from slipguard.control.params import GuardParams
from slipguard.control.state import GraspState, Phase, emptied

OPEN_ANYWAY_S = 0.5
"""The jaws open so long after the request at the latest, whatever is known of the arm: it may be silent for good."""

Outcome = tuple[GraspState, Command]


def ask(state: GraspState, observation: Observation, params: GuardParams) -> Outcome:
    """Granted in every state. Open at once where the arm is known to rest; asked again, the wait gets no longer."""
    width_mm = observation.request.width_mm if observation.request.width_mm is not None else params.release_width_mm
    said = "releasing, as asked"
    if waits(state):
        return _open(replace(state, goal_mm=width_mm), observation, Command(say=said))
    rests = observation.arm is not None and motion.ended(state, observation.arm, observation.now_s)
    state = replace(
        emptied(state, Phase.RELEASED, observation.now_s), goal_mm=width_mm, release_requested=True, braking=not rests
    )
    if rests:
        return _open(state, observation, Command(say=said))
    said += f": when the arm stands, {OPEN_ANYWAY_S:g} s from now at the latest"
    return motion.stop(state, observation, Command(say=said), at_once=True)


def waits(state: GraspState) -> bool:
    """A release was asked for, and the jaws have not been told to open yet."""
    return state.phase is Phase.RELEASED and state.commanded_s == -math.inf


def go_on(state: GraspState, observation: Observation, params: GuardParams) -> tuple[GraspState, Command, Fault | None]:
    """One tick of a release: over when the jaws are open and the arm stands; the fault where they do not open."""
    state, command = motion.brake(state, observation, Command())
    if waits(state):
        return *_open(state, observation, command), None
    gripper = observation.gripper
    late = observation.now_s - state.since_s > params.tuning.stuck_timeout_s
    if gripper is not None and gripper.measured_at_s > state.commanded_s and not gripper.moving:
        if not gripper.holding and state.braking and not late:
            return state, command, None
        if not gripper.holding:
            said = "released; the arm has not said that it stands" if state.braking else "released"
            return (
                emptied(state, Phase.IDLE, observation.now_s),
                replace(command, say=in_one_line(command.say, said)),
                None,
            )
        if observation.now_s - state.commanded_s >= REPEAT_S:
            return replace(state, commanded_s=observation.now_s), replace(command, release_width_mm=state.goal_mm), None
    moving = gripper is not None and gripper.moving
    if observation.now_s - state.since_s <= params.tuning.stuck_timeout_s + params.tuning.closing_timeout_s * moving:
        return state, command, None
    fault = Fault(
        FaultCode.GRIPPER_STUCK,
        f"not open {observation.now_s - state.since_s:.1f} s after the release",
        "look at the gripper, then release again; it is neither guarded nor tightened meanwhile",
    )
    return state, command, fault


def _open(state: GraspState, observation: Observation, command: Command) -> Outcome:
    """Open the jaws if the arm stands or has been waited for long enough."""
    if state.braking and observation.now_s - state.since_s < OPEN_ANYWAY_S:
        return state, command
    state = replace(state, since_s=observation.now_s, commanded_s=observation.now_s)
    return state, replace(command, release_width_mm=state.goal_mm)
