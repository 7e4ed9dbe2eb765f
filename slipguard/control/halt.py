"""Jaws that are closing or tightening stop where they are as soon as the arm's own stop says a person may be near.

The grip that is there is kept. A closing that was cut short is not taken up again by itself: what the jaws have met may
be a hand, so the grasp must be asked for again. The force on what was held already is said again after the stop.
"""

from __future__ import annotations

import math
from dataclasses import replace

from slipguard.control.arm_motion import REPEAT_S
from slipguard.control.messages import Command, Observation, in_one_line
from slipguard.control.state import GraspState, Phase

Outcome = tuple[GraspState, Command]


def near(state: GraspState, person_near: bool) -> GraspState:
    """What the arm says now of a stop of its own."""
    if person_near is state.person_near:
        return state
    return replace(state, person_near=person_near, halted_s=-math.inf)


def jaws(state: GraspState, observation: Observation, command: Command) -> Outcome:
    """Halt jaws on their way, again and again until they say that they rest; a release is let finish."""
    gripper, opening = observation.gripper, state.release_requested and state.commanded_s > -math.inf
    if not state.person_near or opening or gripper is None:
        return state, command
    if not (gripper.moving or gripper.measured_at_s <= state.commanded_s):
        return state, command
    if observation.now_s - state.halted_s < REPEAT_S:
        return state, command
    said = "a person may be near: the jaws are halted on their way" if state.halted_s == -math.inf else None
    unfinished = state.phase in (Phase.CLOSING, Phase.FAULT) and state.adopted and not state.gripped
    state = replace(state, halted_s=observation.now_s, closing_interrupted=state.closing_interrupted or unfinished)
    return state, replace(command, halt=True, say=in_one_line(command.say, said))
