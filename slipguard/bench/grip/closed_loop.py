"""A controller in closed loop with the simulated world, event by event on a virtual clock.

Cameras expose on their schedule. An estimate reaches the controller one latency later. A command is sent at once; the
world models the time until it acts.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from slipguard.control.finger_fusion import fuse
from slipguard.control.messages import (
    Condition,
    ControlRequest,
    FingerHealth,
    HaltJaws,
    HoldForce,
    LiftArm,
    Observation,
    ReleaseJaws,
    StepOutput,
    StopArm,
)
from slipguard.daemon.loop.frame_causes import STALE_S
from slipguard.devices import FINGERS
from slipguard.perception.estimate import Estimate
from slipguard.sim.gel_view import GelView
from slipguard.sim.world import World, WorldTruth

STEP_S = 0.01
NOTHING = ControlRequest()


class FingerModel(Protocol):
    """Perception of one finger. `process` is called at each exposure with the view of the camera."""

    def reset(self) -> None: ...

    def process(self, view: GelView, captured_at_s: float, sequence: int) -> Estimate: ...


class GripController(Protocol):
    """Decides on observations. `exposed` gives the truth at each exposure, for controllers that may use it."""

    def exposed(self, truth: WorldTruth) -> None: ...

    def decide(self, observation: Observation) -> StepOutput: ...


@dataclass
class ClosedLoop:
    """One run.

    Attributes:
        perceiving_s: Time from the arrival of a frame to its estimate.
        trip_s: Delay of commands.
        now_s: The world's clock.
        exposing: Whether the cameras expose.
        gripper_limits_n: Weakest and strongest grip, as the driver reports them.
        outage: Returns whether the frames of a finger are lost at a time.
        outputs: All with a command or message, with their times.
        messages: Messages of the controller, with their times.
        trace: The truth at each control step.
    """

    world: World
    controller: GripController
    fingers: Mapping[str, FingerModel]
    rng: np.random.Generator
    perceiving_s: float = 0.006
    trip_s: float = 0.0
    now_s: float = 100.0
    exposing: bool = True
    gripper_limits_n: tuple[float, float] = (20.0, 235.0)
    outage: Callable[[str, float], bool] = lambda finger, now_s: False
    outputs: list[tuple[float, StepOutput]] = field(default_factory=list)
    messages: list[str] = field(default_factory=list)
    trace: list[WorldTruth] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._estimates: dict[str, Estimate | None] = dict.fromkeys(FINGERS)
        self._events: list[tuple[float, int, Callable[[], None]]] = []
        self._order = 0
        self._step = 0
        self._start_s = self.now_s
        self._sequence = dict.fromkeys(FINGERS, 0)
        self._reset_s = -math.inf
        self._request = NOTHING
        for finger in FINGERS:
            self._schedule_exposure(finger)
        self._schedule_step()

    def ask(self, request: ControlRequest) -> None:
        """Give the controller a request, at once."""
        self._request = request
        self._decide()

    def until(self, done: Callable[[], bool], limit_s: float) -> bool:
        """Run until `done`, checked after each event, or for `limit_s`; return whether it was done."""
        end_s = self.now_s + limit_s
        while self._events[0][0] <= end_s:
            self.now_s, _, action = heapq.heappop(self._events)
            action()
            if done():
                return True
        self.now_s = end_s
        return False

    def wait(self, seconds: float) -> None:
        """Run for this time."""
        self.until(lambda: False, seconds)

    def later(self, when_s: float, action: Callable[[], None]) -> None:
        """Call `action` at this time; at once if it has passed."""
        self._order += 1
        heapq.heappush(self._events, (max(when_s, self.now_s), self._order, action))

    def truth(self) -> WorldTruth:
        """Return the present truth."""
        return self.world.truth(self.now_s)

    def _schedule_step(self) -> None:
        self._step += 1
        self.later(self._start_s + self._step * STEP_S, self._on_step)

    def _on_step(self) -> None:
        self._schedule_step()
        self._decide()
        self.trace.append(self.world.truth(self.now_s))

    def _schedule_exposure(self, finger: str) -> None:
        self._sequence[finger] += 1
        due_s = self._start_s + self._sequence[finger] / self.world.camera(finger).fps
        self.later(due_s, lambda: self._expose(finger))

    def _expose(self, finger: str) -> None:
        self._schedule_exposure(finger)
        if not self.exposing:
            return
        if finger == FINGERS[0]:
            self.controller.exposed(self.world.truth(self.now_s))
        camera = self.world.camera(finger)
        if self.rng.random() < camera.drop_probability or self.outage(finger, self.now_s):
            return
        limit_s = 0.4 / camera.fps
        stamp_s = self.now_s + min(max(float(self.rng.normal(0.0, camera.jitter_s)), -limit_s), limit_s)
        view = self.world.view(finger, self.now_s)
        estimate = self.fingers[finger].process(view, stamp_s, self._sequence[finger])
        exposed_s = self.now_s
        self.later(
            self.now_s + camera.latency_s + self.perceiving_s, lambda: self._receive(finger, exposed_s, estimate)
        )

    def _receive(self, finger: str, exposed_s: float, estimate: Estimate) -> None:
        if exposed_s >= self._reset_s:
            self._estimates[finger] = estimate
            self._decide()

    def _decide(self) -> None:
        (left, left_health), (right, right_health) = (self._fresh(finger) for finger in FINGERS)
        request, self._request = self._request, NOTHING
        observation = Observation(
            now_s=self.now_s,
            fused=fuse(left, right),
            left=left_health,
            right=right_health,
            gripper=self.world.gripper_state(self.now_s),
            arm=self.world.arm_state(self.now_s),
            request=request,
            gripper_limits_n=self.gripper_limits_n,
        )
        self._apply(self.controller.decide(observation))

    def _fresh(self, finger: str) -> tuple[Estimate | None, FingerHealth]:
        """Return estimate and health as the daemon does: no estimate if it is stale; healthy before the first frame."""
        estimate = self._estimates[finger]
        if estimate is None:
            return None, FingerHealth()
        age_s = self.now_s - estimate.captured_at_s
        stale = age_s > STALE_S
        return None if stale else estimate, FingerHealth(Condition.STALE if stale else Condition.FRESH, age_s)

    def _apply(self, output: StepOutput) -> None:
        if output != StepOutput(fault=output.fault):
            self.outputs.append((self.now_s, output))
        if output.text:
            self.messages.append(f"{self.now_s - self._start_s:.3f} {output.text}")
        if output.new_reference:
            self._reset_s = self.now_s
            for finger in FINGERS:
                self.fingers[finger].reset()
                self._estimates[finger] = None
        due_s = self.now_s + self.trip_s
        match output.gripper:
            case HoldForce(force_n=force_n):
                self.later(due_s, lambda: self._hold(force_n))
            case ReleaseJaws(width_mm=width_mm):
                self.later(due_s, lambda: self.world.command_release(self.now_s, width_mm))
            case HaltJaws():
                self.later(due_s, lambda: self.world.command_halt(self.now_s))
        match output.arm:
            case StopArm():
                self.world.command_stop(self.now_s)
            case LiftArm(height_mm=height_mm, speed_mm_s=speed_mm_s):
                self.world.command_lift(self.now_s, height_mm, speed_mm_s)

    def _hold(self, force_n: float) -> None:
        self.world.command_hold(self.now_s, force_n)
