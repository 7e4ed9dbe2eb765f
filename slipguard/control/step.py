"""One control step: the supervisor, then the controller. The daemon calls it once per cycle."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from slipguard.control.controller import step
from slipguard.control.messages import Command, Observation
from slipguard.control.params import GuardParams
from slipguard.control.state import GraspState
from slipguard.control.supervisor import Supervision, watch


@dataclass(frozen=True, slots=True)
class ControlState:
    """Memory of the controller and of the supervisor. A new one adopts what the gripper holds at the start."""

    grasp: GraspState = field(default_factory=GraspState)
    supervision: Supervision = field(default_factory=Supervision)


def control_step(state: ControlState, observation: Observation, params: GuardParams) -> tuple[ControlState, Command]:
    """Return the next state and the command: the supervisor first, then the controller. Pure.

    `observation.fault` and `observation.also` are filled in here.
    """
    memory, faults = watch(state.supervision, state.grasp, observation, params)
    if faults:
        observation = replace(observation, fault=faults[0], also=faults[1:])
    grasp, command = step(state.grasp, observation, params)
    return ControlState(grasp, memory), command
