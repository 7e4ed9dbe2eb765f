"""Stop on request: the arm halts at once, the grip stays, and nothing moves until the next request.

A stop is granted in every phase, on top of what the step has decided, and has the same effect as the stop of a fault:
`StopArm`, again until the arm stands. A held object is guarded as before, so slip is still met with force. Jaws that
have not met an object yet are halted, too, because a hand may be between them. A release goes on: jaws that open free a
hand, and half-open jaws hold nothing.
"""

from __future__ import annotations

from dataclasses import replace

from slipguard.control import arm_motion
from slipguard.control.arm_motion import Result
from slipguard.control.messages import HaltJaws, Observation, StepOutput, StopArm
from slipguard.control.params import GuardParams
from slipguard.control.reports import Text
from slipguard.control.state import MOVING, GraspState, HandsOff, Phase, RequestedStop

NO_GRIP_YET = frozenset({Phase.IDLE, Phase.CLOSING, Phase.FAULT})
"""Phases in which jaws may close on something that is not held yet."""


def request_stop(state: GraspState, output: StepOutput, observation: Observation) -> Result:
    """Grant a stop, after the rest of this step."""
    now_s, before = observation.now_s, state.phase
    jaws = (
        before in NO_GRIP_YET and state.adoption.done and not (state.grip.closed or state.hands_off.release_requested)
    )
    if before in MOVING:
        state = state.entered(Phase.HOLDING, now_s)
    elif before is Phase.CLOSING:
        state = replace(state.emptied(Phase.IDLE, now_s), hands_off=HandsOff(closing_interrupted=True))
    elif before is Phase.FAULT and jaws:
        state = replace(state, hands_off=HandsOff(closing_interrupted=True))
    motion = replace(state.arm, putting_down=False, commanded_s=now_s)
    state = replace(state, arm=motion, stop=RequestedStop(jaws))
    texts = {Phase.CLOSING: Text.STOPPED_CLOSING, Phase.RELEASED: Text.STOPPED_RELEASING}
    messages = (texts.get(before, Text.STOPPED).message(), *output.messages)
    return state, replace(output, arm=StopArm(), gripper=HaltJaws() if jaws else output.gripper, messages=messages)


def follow_stop(state: GraspState, output: StepOutput, observation: Observation, params: GuardParams) -> Result:
    """Repeat a requested stop until the arm stands. In guard mode, another program may move it afterwards."""
    stop, arm = state.stop, observation.arm
    if stop is None:
        return state, output
    if stop.arm_stood:
        moved_by_other = params.mode == "guard" and arm is not None and arm.moving
        return replace(state, stop=None) if moved_by_other else state, output
    if arm is not None and arm_motion.has_ended(state, arm, observation.now_s):
        return replace(state, stop=replace(stop, arm_stood=True)), output
    return arm_motion.stop(state, observation, output)
