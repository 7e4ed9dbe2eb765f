"""A controller in closed loop with the simulated world, event by event on a virtual clock."""

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
from slipguard.daemon.loop.finger import STALE_S
from slipguard.perception.estimate import Estimate
from slipguard.sim.gel_view import GelView
from slipguard.sim.world import World, WorldTruth

TICK_S = 0.01
FINGERS = ("left", "right")
NOTHING = ControlRequest()
SLIDES_MM_S = 0.5
"""Truly slipping and going down faster than this is sliding; what is slower ends within a micrometre or so."""


class FingerModel(Protocol):
    """One finger's eye. `look` is called at each exposure with what lies before the camera."""

    def reset(self) -> None: ...

    def look(self, view: GelView, captured_at_s: float, sequence: int) -> Estimate: ...


class GripController(Protocol):
    """Decides from what is seen. `exposed` is for those that know the truth: called at each exposure."""

    def exposed(self, truth: WorldTruth) -> None: ...

    def decide(self, observation: Observation) -> StepOutput: ...


@dataclass(slots=True)
class LoopTrace:
    """How it went, a sample a tick."""

    time_s: list[float] = field(default_factory=list)
    rotation_deg: list[float] = field(default_factory=list)
    slip_deg: list[float] = field(default_factory=list)
    sliding: list[bool] = field(default_factory=list)
    force_n: list[float] = field(default_factory=list)
    target_n: list[float] = field(default_factory=list)

    def add(self, truth: WorldTruth) -> None:
        self.time_s.append(truth.time_s)
        self.rotation_deg.append(truth.rotation_deg)
        self.slip_deg.append(truth.slip_deg)
        self.sliding.append(truth.slipping and abs(truth.slip_rate_mm_s) > SLIDES_MM_S)
        self.force_n.append(truth.force_n)
        self.target_n.append(truth.applied_n)


@dataclass
class ClosedLoop:
    """One run. sights: by finger; perceiving_s: from a frame's arrival to its estimate. now_s: the world's clock.

    looking: cameras expose only while it is set. blind: whether a finger's frames fail to come at a time. says: what
    the controller said, with the time. outputs: all with a command or message.
    """

    world: World
    controller: GripController
    fingers: Mapping[str, FingerModel]
    rng: np.random.Generator
    perceiving_s: float = 0.006
    trip_s: float = 0.0
    now_s: float = 100.0
    looking: bool = True
    blind: Callable[[str, float], bool] = lambda finger, now_s: False
    outputs: list[tuple[float, StepOutput]] = field(default_factory=list)
    says: list[str] = field(default_factory=list)
    trace: LoopTrace = field(default_factory=LoopTrace)

    def __post_init__(self) -> None:
        self._estimates: dict[str, Estimate | None] = dict.fromkeys(FINGERS)
        self._events: list[tuple[float, int, Callable[[], None]]] = []
        self._order = 0
        self._tick = 0
        self._start_s = self.now_s
        self._sequence = dict.fromkeys(FINGERS, 0)
        self._reset_s = -math.inf
        self._request = NOTHING
        for finger in FINGERS:
            self._expose_next(finger)
        self._tick_next()

    def ask(self, request: ControlRequest) -> None:
        """Hand a request to the controller, now."""
        self._request = request
        self._decide()

    def until(self, done: Callable[[], bool], limit_s: float) -> bool:
        """Run until `done` (asked after each event) or for so long; whether it was done."""
        end_s = self.now_s + limit_s
        while self._events[0][0] <= end_s:
            self.now_s, _, action = heapq.heappop(self._events)
            action()
            if done():
                return True
        self.now_s = end_s
        return False

    def wait(self, seconds: float) -> None:
        """Run for so long."""
        self.until(lambda: False, seconds)

    def later(self, when_s: float, action: Callable[[], None]) -> None:
        """Do something at a time."""
        self._order += 1
        heapq.heappush(self._events, (max(when_s, self.now_s), self._order, action))

    def truth(self) -> WorldTruth:
        """What really happens now."""
        return self.world.truth(self.now_s)

    # What happens by itself.

    def _tick_next(self) -> None:
        self._tick += 1
        self.later(self._start_s + self._tick * TICK_S, self._on_tick)

    def _on_tick(self) -> None:
        self._tick_next()
        self._decide()
        self.trace.add(self.world.truth(self.now_s))

    def _expose_next(self, finger: str) -> None:
        self._sequence[finger] += 1
        due_s = self._start_s + self._sequence[finger] / self.world.camera(finger).fps
        self.later(due_s, lambda: self._expose(finger))

    def _expose(self, finger: str) -> None:
        self._expose_next(finger)
        if not self.looking:
            return
        if finger == FINGERS[0]:
            self.controller.exposed(self.world.truth(self.now_s))
        camera = self.world.camera(finger)
        if self.rng.random() < camera.drop_probability or self.blind(finger, self.now_s):
            return
        limit_s = 0.4 / camera.fps
        stamp_s = self.now_s + min(max(float(self.rng.normal(0.0, camera.jitter_s)), -limit_s), limit_s)
        view = self.world.view(finger, self.now_s)
        estimate = self.fingers[finger].look(view, stamp_s, self._sequence[finger])
        exposed_s = self.now_s
        self.later(self.now_s + camera.latency_s + self.perceiving_s, lambda: self._told(finger, exposed_s, estimate))

    def _told(self, finger: str, exposed_s: float, estimate: Estimate) -> None:
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
        )
        self._obey(self.controller.decide(observation))

    def _fresh(self, finger: str) -> tuple[Estimate | None, FingerHealth]:
        """As the daemon has it: a finger whose newest frame is old says nothing. One that has not begun is well."""
        estimate = self._estimates[finger]
        if estimate is None:
            return None, FingerHealth()
        age_s = self.now_s - estimate.captured_at_s
        stale = age_s > STALE_S
        return None if stale else estimate, FingerHealth(Condition.STALE if stale else Condition.FRESH, age_s)

    def _obey(self, output: StepOutput) -> None:
        if output != StepOutput(fault=output.fault):
            self.outputs.append((self.now_s, output))
        if output.text:
            self.says.append(f"{self.now_s - self._start_s:.3f} {output.text}")
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
