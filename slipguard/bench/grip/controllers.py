"""The controllers that are compared: slipguard's, no guard, a fixed step, and an oracle that knows the truth."""

from __future__ import annotations

from dataclasses import dataclass, field

from slipguard.control.control_step import ControlState, control_step
from slipguard.control.messages import HoldForce, LiftArm, Observation, RequestKind, StepOutput, StopArm
from slipguard.control.params import GuardParams
from slipguard.sim.world import WorldTruth

STEP = 1.10
STEP_ABOVE_DEG = 5.0
"""The fixed step increases the force by 10 % at each frame with a rotation above this."""
ORACLE_ABOVE_DEG = 0.1
"""From this slip on the oracle tightens."""
ORACLE_TIMES = 1.5
SETTLED_DEG, SETTLE_S = 1.0, 0.3
"""A stopped arm continues after a rotation below this for this time, as with slipguard's controller."""
REACHED_MM = 0.5


@dataclass(slots=True)
class SlipguardController:
    """slipguard's supervisor and controller."""

    params: GuardParams
    state: ControlState = field(default_factory=ControlState)

    def exposed(self, truth: WorldTruth) -> None:
        """Ignore the truth."""

    def decide(self, observation: Observation) -> StepOutput:
        self.state, output = control_step(self.state, observation, self.params)
        return output


@dataclass(slots=True)
class UnguardedController:
    """Grips and lifts as requested. Subclasses tighten; the arm then pauses until the object has settled.

    goal_mm, speed_mm_s: of the lift. still_deg: rotation since still_s.
    """

    target_n: float = 0.0
    goal_mm: float | None = None
    speed_mm_s: float = 0.0
    still_deg: float = 0.0
    still_s: float = 0.0

    def exposed(self, truth: WorldTruth) -> None:
        """Ignore the truth."""

    def decide(self, observation: Observation) -> StepOutput:
        request = observation.request
        if request.kind is RequestKind.GRASP and request.force_n is not None:
            self.target_n = request.force_n
            return StepOutput(HoldForce(self.target_n))
        if request.kind is RequestKind.LIFT and request.height_mm is not None and observation.arm is not None:
            self.goal_mm, self.speed_mm_s = observation.arm.height_mm + request.height_mm, request.speed_mm_s or 0.0
            return StepOutput(arm=LiftArm(request.height_mm, self.speed_mm_s))
        more_n = self.more_n(observation)
        if more_n is not None:
            self.target_n, self.still_s = more_n, observation.now_s
            return StepOutput(HoldForce(more_n), StopArm())
        return StepOutput(arm=self._continue_lift(observation))

    def more_n(self, observation: Observation) -> float | None:
        """Return the force to tighten to, above `target_n`; None to keep the force."""
        return None

    def _continue_lift(self, observation: Observation) -> LiftArm | None:
        """Return the rest of the lift if the arm has stopped early and object and gripper have settled."""
        rotation_deg = observation.fused.rotation_deg if observation.fused is not None else None
        moves = observation.gripper is None or observation.gripper.moving or rotation_deg is None
        if moves or abs((rotation_deg or 0.0) - self.still_deg) > SETTLED_DEG:
            self.still_deg, self.still_s = rotation_deg or 0.0, observation.now_s
        if (
            self.goal_mm is None
            or observation.arm is None
            or observation.arm.moving
            or observation.now_s - self.still_s < SETTLE_S
        ):
            return None
        rest_mm = self.goal_mm - observation.arm.height_mm
        return LiftArm(rest_mm, self.speed_mm_s) if rest_mm > REACHED_MM else None


@dataclass(slots=True)
class FixedStep(UnguardedController):
    """Increases the force by 10 % at each new frame with a rotation above 5 degrees, up to `force_max_n`."""

    force_max_n: float = 130.0
    captured_s: float = -1.0

    def more_n(self, observation: Observation) -> float | None:
        fused = observation.fused
        if fused is None or fused.rotation_deg is None or fused.captured_at_s <= self.captured_s:
            return None
        self.captured_s = fused.captured_at_s
        if abs(fused.rotation_deg) <= STEP_ABOVE_DEG or self.target_n >= self.force_max_n:
            return None
        return min(self.target_n * STEP, self.force_max_n)


@dataclass(slots=True)
class Oracle(UnguardedController):
    """Knows the true slip one latency later, the needed force and the gripper's gain; it needs one command.

    latency_s: from exposure to the decision.
    """

    latency_s: float = 0.0
    gain: float = 1.0
    force_max_n: float = 130.0
    known_s: float | None = None
    wanted_n: float = 0.0

    def exposed(self, truth: WorldTruth) -> None:
        if self.known_s is None and abs(truth.slip_deg) > ORACLE_ABOVE_DEG:
            self.known_s = truth.time_s + self.latency_s
            self.wanted_n = min(ORACLE_TIMES * truth.needed_force_n / self.gain, self.force_max_n)

    def more_n(self, observation: Observation) -> float | None:
        if self.known_s is None or observation.now_s < self.known_s or self.target_n >= self.wanted_n:
            return None
        return self.wanted_n
