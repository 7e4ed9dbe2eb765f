"""The controllers that are compared: slipguard's, the baselines, and a bound that knows load and friction."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from slipguard.control.control_step import ControlState, control_step
from slipguard.control.messages import HoldForce, LiftArm, Observation, RequestKind, StepOutput, StopArm
from slipguard.control.params import GuardParams
from slipguard.sim.world import WorldTruth

FIXED_STEP = 1.10
FIXED_STEP_ABOVE_DEG = 5.0
"""The fixed step increases the force by 10 % at each frame with a rotation above this."""
NAIVE_N = 10.0
SETTLED_DEG, SETTLE_S = 1.0, 0.3
"""A stopped arm continues after a rotation below this for this time."""
VISIBLE_DEG, VISIBLE_MM = 0.1, 0.02
"""A motion beyond one of these exceeds the noise of the pipeline on textured objects."""
REACHED_MM = 0.5
SLOW_MM, SLOW_MM_S = 15.0, 20.0
"""Every lift starts slowly, as slipguard's does by default."""


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
    """Grips and lifts as requested, the first part slowly as slipguard does. Subclasses tighten and pause the arm.

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
            self.still_s = -math.inf
            start_mm = min(request.height_mm, SLOW_MM)
            more_n = self.more_n(observation)
            if more_n is None:
                return StepOutput(arm=LiftArm(start_mm, min(self.speed_mm_s, SLOW_MM_S)))
        else:
            more_n = self.more_n(observation)
        if more_n is not None:
            self.target_n, self.still_s = more_n, observation.now_s
            return StepOutput(HoldForce(more_n), StopArm())
        return StepOutput(arm=self._continue_lift(observation))

    def more_n(self, observation: Observation) -> float | None:
        """Return the force to tighten to, above `target_n`; None to keep the force."""
        return None

    def _continue_lift(self, observation: Observation) -> LiftArm | None:
        """Return the rest of the lift if the arm stands, and object and gripper have settled since a tightening."""
        arm, gripper, now_s = observation.arm, observation.gripper, observation.now_s
        rotation_deg = observation.fused.rotation_deg if observation.fused is not None else None
        if self.still_s > -math.inf:
            changed = rotation_deg is not None and abs(rotation_deg - self.still_deg) > SETTLED_DEG
            if changed or gripper is None or gripper.moving:
                self.still_deg, self.still_s = rotation_deg or self.still_deg, now_s
        if self.goal_mm is None or arm is None or arm.moving or now_s - self.still_s < SETTLE_S:
            return None
        rest_mm = self.goal_mm - arm.height_mm
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
        if abs(fused.rotation_deg) <= FIXED_STEP_ABOVE_DEG or self.target_n >= self.force_max_n:
            return None
        return min(self.target_n * FIXED_STEP, self.force_max_n)


@dataclass(slots=True)
class NaiveSteps(UnguardedController):
    """Adds 10 N for each `step_deg` of rotation, up to `force_max_n`: what anyone would write first."""

    force_max_n: float = 130.0
    step_deg: float = 2.0
    answered: int = 0

    def more_n(self, observation: Observation) -> float | None:
        rotation_deg = observation.fused.rotation_deg if observation.fused is not None else None
        steps = math.floor(abs(rotation_deg or 0.0) / self.step_deg) - self.answered
        if steps <= 0 or self.target_n >= self.force_max_n:
            return None
        self.answered += steps
        return min(self.target_n + NAIVE_N * steps, self.force_max_n)


@dataclass(slots=True)
class Clairvoyant(UnguardedController):
    """Commands the force that a load needs at the moment the load begins to arrive.

    wanted_n: set by the bench at lift-off and at the event. It lies within the force limit.
    """

    wanted_n: float = 0.0

    def load_begins(self, wanted_n: float, truth: WorldTruth) -> None:
        """Take the force that the arriving load needs."""
        self.wanted_n = wanted_n

    def more_n(self, observation: Observation) -> float | None:
        return self.wanted_n if self.wanted_n > self.target_n else None


@dataclass(slots=True)
class Reactive(Clairvoyant):
    """Commands the force that a load needs once the load has moved the object visibly: no controller can react earlier.

    What happens until then, and until the jaws act, is the physical bound: camera, wire and jaws.

    Attributes:
        delay_s: from an exposure to its estimate.
        start: the truth when the load began to arrive.
        visible_s: when the controller has the first estimate of a moved object.
    """

    delay_s: float = 0.0
    start: WorldTruth | None = None
    visible_s: float = math.inf

    def load_begins(self, wanted_n: float, truth: WorldTruth) -> None:
        """Take the force that the arriving load needs; act on it only once the load is visible."""
        self.wanted_n, self.start, self.visible_s = wanted_n, truth, math.inf

    def exposed(self, truth: WorldTruth) -> None:
        if self.start is None or self.visible_s < math.inf:
            return
        moved_deg, moved_mm = truth.rotation_deg - self.start.rotation_deg, truth.slip_mm - self.start.slip_mm
        if abs(moved_deg) > VISIBLE_DEG or abs(moved_mm) > VISIBLE_MM:
            self.visible_s = truth.time_s + self.delay_s

    def more_n(self, observation: Observation) -> float | None:
        visible = observation.now_s >= self.visible_s
        return self.wanted_n if visible and self.wanted_n > self.target_n else None
