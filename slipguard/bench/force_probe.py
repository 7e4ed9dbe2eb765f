"""The law with a nudge: while something is held, an answered frame now and then is answered with one force step more.

Slip gives a command or two in a lift; a latency's 99th percentile needs hundreds. Everything else is the law's own.
"""

from __future__ import annotations

import random
from dataclasses import dataclass, field, replace

from slipguard.control.messages import Command, Observation
from slipguard.control.params import GuardParams
from slipguard.control.state import Phase
from slipguard.control.step import ControlState, control_step

STEP_N = 0.85
"""A little more than one count of the force register (0.843 N)."""
PAUSE_S = (0.12, 0.20)
"""Between two commands, drawn anew each time: at no fixed phase to cameras and polls, and the gripper comes to rest."""


@dataclass(slots=True)
class ForceProbe:
    """One command: the force, when the frame behind it was exposed, and when it was decided on."""

    force_n: float
    captured_at_s: float
    decided_at_s: float


@dataclass(slots=True)
class ProbingController:
    """To be given to a service in place of `control_step`. left: how many commands are still to be given."""

    left: int
    probes: list[ForceProbe] = field(default_factory=list)
    _due_s: float = 0.0
    _captured_at_s: float = 0.0
    _random: random.Random = field(default_factory=lambda: random.Random(0))

    def __call__(
        self, state: ControlState, observation: Observation, params: GuardParams
    ) -> tuple[ControlState, Command]:
        """One tick."""
        state, command = control_step(state, observation, params)
        fused = observation.fused
        if fused is None or fused.captured_at_s <= self._captured_at_s:
            return state, command
        self._captured_at_s = fused.captured_at_s
        force_n = state.grasp.target_n + STEP_N
        calm = state.grasp.phase is Phase.HOLDING and state.grasp.slip is None and command.hold_force_n is None
        if not calm or self.left <= 0 or observation.now_s < self._due_s or force_n > observation.gripper_limits_n[1]:
            return state, command
        self.left -= 1
        self._due_s = observation.now_s + self._random.uniform(*PAUSE_S)
        self.probes.append(ForceProbe(force_n, fused.captured_at_s, observation.now_s))
        grasp = replace(state.grasp, target_n=force_n, commanded_s=observation.now_s)
        return replace(state, grasp=grasp), replace(command, hold_force_n=force_n)
