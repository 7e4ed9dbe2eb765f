"""The course of one run of a scenario: grip, lift, let the load arrive, hold, and measure."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from slipguard.bench.grip.closed_loop import ClosedLoop
from slipguard.bench.grip.controllers import (
    REACHED_MM,
    Clairvoyant,
    Reactive,
    SlipguardController,
    UnguardedController,
)
from slipguard.bench.grip.disturbances import DISTURBANCES, LASTS_S, LOWERING, PEAK_M_S2, Disturbance, pulse, pushed
from slipguard.bench.grip.perception_models import ModeledFinger
from slipguard.bench.grip.scenarios import LIFT_MM, GripScenario
from slipguard.control.messages import ControlRequest, RequestKind
from slipguard.control.state import FORCE_TOLERANCE_N
from slipguard.devices import FINGERS
from slipguard.limit_surface import GRAVITY_M_S2

BOUND_MARGIN = 1.02
"""The clairvoyant bound grips with this much more than the needed force."""
REACTIVE_MARGIN = 1.3
"""The reactive bound must also stop an object that moves already."""
CLOSING_MAX_S = 6.0
QUIET_S = 0.7
LIFT_MAX_S, EVENT_MAX_S = 8.0, 6.0
PAUSE_S = 0.5
"""The object rests this long between lift and event."""
STILL_DEG_S, STILL_MM_S, STILL_S = 0.5, 0.5, 0.6
SLIPPED_DEG = 0.05
DROPPED_DEG, DROPPED_MM = 60.0, 12.0
"""The slip of a dropped object."""
OUTLIER_DEG = 0.6
"""Error of a single frame in both fingers, such as a flicker that both cameras share."""


@dataclass(frozen=True, slots=True)
class Disturbed:
    """What a disturbance of a held object has changed. Forces are true ones; slip_deg: that it added."""

    name: str
    before_n: float
    after_n: float
    slip_deg: float
    dropped: bool


@dataclass(frozen=True, slots=True)
class GripOutcome:
    """Result of one run.

    Attributes:
        slip_deg, slide_mm: True slip at the end, without elastic torsion and shear; of a dropped object at least
            `DROPPED_DEG` and `DROPPED_MM`.
        force_n: Largest true force.
        arrested_s: Time from the first slip to the last; None without slip.
        answered_s: Time from the first slip under the last load to the next command or fault; None without either.
        tightenings: Forces commanded from lift-off until rest.
        early: Whether it tightened before any slip.
        up: Whether the lift reached its height.
    """

    controller: str
    slip_deg: float
    slide_mm: float
    force_n: float
    needed_n: float
    arrested_s: float | None
    tightenings: int
    early: bool
    dropped: str | None
    fault: str | None
    up: bool
    answered_s: float | None = None
    messages: tuple[str, ...] = ()
    disturbed: tuple[Disturbed, ...] = ()

    @property
    def held(self) -> int:
        """How many disturbances of the held object made the controller tighten."""
        return sum(one.after_n > one.before_n + FORCE_TOLERANCE_N for one in self.disturbed)

    @property
    def force_over_needed(self) -> float:
        return self.force_n / self.needed_n


class LiftCourse:
    """One run, step by step; `outcome` measures it afterwards."""

    def __init__(self, scenario: GripScenario, loop: ClosedLoop) -> None:
        self._scenario, self._loop = scenario, loop
        self._begun_s = self._loaded_s = math.inf
        self._watches = type(loop.controller) is not UnguardedController

    def grip(self, force_n: float) -> None:
        """Close the jaws until the grip is firm; the cameras expose from then on."""
        loop = self._loop
        loop.exposing = False
        loop.ask(ControlRequest(RequestKind.GRASP, force_n=force_n))

        def firm() -> bool:
            state = loop.world.gripper_state(loop.now_s)
            return state.holding and not state.moving

        assert loop.until(firm, CLOSING_MAX_S), "the jaws did not close"
        loop.exposing = self._watches
        loop.wait(QUIET_S + self._scenario.pose.left.latency_s + 6.0 / self._scenario.pose.left.fps)

    def lift(self) -> None:
        """Lift the object, unless its support is removed instead."""
        scenario, loop = self._scenario, self._loop
        self._begun_s = loop.now_s
        self._lose_frames()
        if scenario.event == "support gone":
            return
        self._known(scenario.base_needed_n)
        loop.ask(ControlRequest(RequestKind.LIFT, height_mm=LIFT_MM, speed_mm_s=scenario.lift_speed_mm_s))
        self._rest(LIFT_MAX_S + 2.0 * LIFT_MM / scenario.lift_speed_mm_s, LIFT_MM - REACHED_MM)

    def event(self) -> None:
        """Let the rest of the load arrive."""
        scenario, loop = self._scenario, self._loop
        world, from_s, onset_s = loop.world, loop.now_s, scenario.onset_s
        if scenario.event == "lift" or loop.truth().dropped is not None:
            return
        if scenario.event == "support gone":
            self._known(scenario.needed_n)
            world.take_table(from_s)
        else:
            loop.wait(PAUSE_S)
            from_s = loop.now_s
            self._known(scenario.needed_n)
            later_kg = (1.0 - scenario.base_share) * scenario.mass_kg
            if scenario.event == "mass added":
                world.add_mass(from_s, later_kg)
            elif scenario.event == "contact":
                push_n, lever_m = later_kg * GRAVITY_M_S2, 1e-3 * scenario.lever_mm
                world.push(from_s, lambda now_s: pushed(push_n, lever_m, (now_s - from_s) / onset_s))
            else:
                peak_m_s2 = GRAVITY_M_S2 * (1.0 / scenario.base_share - 1.0)
                world.shake(from_s, lambda now_s: peak_m_s2 * pulse((now_s - from_s) / onset_s))
        loop.wait(onset_s if scenario.event in ("contact", "acceleration") else 0.0)
        self._rest(EVENT_MAX_S, 0.0)
        if scenario.event == "acceleration":
            world.shake(loop.now_s, None)

    def disturb(self) -> tuple[Disturbed, ...]:
        """Disturb the held object in every way of the table, then put it down; return what each has changed."""
        loop, found = self._loop, []
        self._known((1.0 + PEAK_M_S2 / GRAVITY_M_S2) * self._scenario.needed_n)
        self._flicker()
        for name, one in DISTURBANCES.items():
            found.append(self._watched(name, partial(self._apply, one)))
        if isinstance(loop.controller, SlipguardController):
            found.append(self._watched(LOWERING, self._put_down))
        return tuple(found)

    def _watched(self, name: str, action: Callable[[], None]) -> Disturbed:
        before = self._loop.truth()
        action()
        after = self._loop.truth()
        dropped = before.dropped is None and after.dropped is not None
        return Disturbed(name, before.force_n, after.force_n, abs(after.slip_deg - before.slip_deg), dropped)

    def _apply(self, one: Disturbance) -> None:
        loop, from_s = self._loop, self._loop.now_s
        acceleration, share = one.acceleration_m_s2, one.push_share
        if acceleration is not None:
            loop.world.shake(from_s, lambda now_s: acceleration(now_s - from_s))
        if share is not None:
            weight_n, lever_m = self._scenario.mass_kg * GRAVITY_M_S2, 1e-3 * self._scenario.lever_mm

            def push(now_s: float) -> tuple[float, float]:
                part = share(now_s - from_s)
                return part * weight_n, part * weight_n * lever_m

            loop.world.push(from_s, push)
        loop.wait(LASTS_S)
        loop.world.shake(loop.now_s, None)
        loop.world.push(loop.now_s, None)

    def _put_down(self) -> None:
        self._loop.ask(ControlRequest(RequestKind.LOWER))
        self._rest(LIFT_MAX_S, -math.inf)

    def _flicker(self) -> None:
        """Let a frame of both fingers be wrong at once, as a rotation of the object."""
        for finger, sign in zip(FINGERS, (1.0, -1.0), strict=True):
            model = self._loop.fingers[finger]
            if isinstance(model, ModeledFinger):
                model.add_outliers((self._loop.now_s + 0.5 * LASTS_S,), sign * OUTLIER_DEG)

    def _lose_frames(self) -> None:
        """Lose the frames of the scenario's outage from now on."""
        if self._scenario.outage is not None:
            finger, from_s, lasts_s = self._scenario.outage
            from_s += self._loop.now_s
            self._loop.outage = lambda name, now_s: name == finger and from_s <= now_s < from_s + lasts_s

    def _known(self, needed_n: float) -> None:
        """Give the bounds the force of the load that arrives now. The reactive one leaves a grip that holds it."""
        controller, gripper, truth = self._loop.controller, self._scenario.pose.gripper, self._loop.truth()
        self._loaded_s = truth.time_s
        if not isinstance(controller, Clairvoyant):
            return
        margin = BOUND_MARGIN
        if isinstance(controller, Reactive):
            margin = REACTIVE_MARGIN if truth.force_n < needed_n else 0.0
        controller.load_begins(min(margin * needed_n / gripper.gain, self._scenario.force_max_n), truth)

    def _rest(self, limit_s: float, height_mm: float) -> None:
        """Run until the object rests at this height, is dropped, or the time is over."""
        loop, still_s = self._loop, [self._loop.now_s]
        quiet_s = STILL_S + self._scenario.pose.left.latency_s

        def over() -> bool:
            truth = loop.truth()
            if truth.dropped is not None:
                return True
            moves = abs(truth.rate_deg_s) > STILL_DEG_S or abs(truth.slip_rate_mm_s) > STILL_MM_S
            if moves or truth.height_mm < height_mm or loop.world.gripper_state(loop.now_s).moving:
                still_s[0] = loop.now_s
            return loop.now_s - still_s[0] > quiet_s

        loop.until(over, limit_s)

    def _answered_s(self, times: NDArray[np.float64], slips: NDArray[np.float64]) -> float | None:
        """Return the time from the first slip since the last load began to arrive to the next command or fault."""
        after = times >= self._loaded_s
        slipped = times[after][slips[after] > slips[after][:1] + SLIPPED_DEG]
        if slipped.size == 0:
            return None
        answers_s = [
            at_s - float(slipped[0])
            for at_s, output in self._loop.outputs
            if at_s >= slipped[0] and (output.hold_force_n is not None or output.fault is not None)
        ]
        return min(answers_s, default=None)

    @property
    def fault(self) -> str | None:
        """The latched fault of slipguard's controller."""
        controller = self._loop.controller
        fault = controller.state.grasp.fault if isinstance(controller, SlipguardController) else None
        return None if fault is None else str(fault.code)

    def outcome(self, controller: str) -> GripOutcome:
        """Return what the run has shown so far. controller: its name."""
        loop, scenario = self._loop, self._scenario
        truth, trace = loop.truth(), loop.trace
        times = np.array([now.time_s for now in trace])
        slips = np.hypot([now.slip_deg for now in trace], [now.slip_mm - now.elastic_mm for now in trace])
        final = math.hypot(truth.slip_deg, truth.slip_mm - truth.elastic_mm)
        first_slip_s = float(times[slips > SLIPPED_DEG][0]) if (slips > SLIPPED_DEG).any() else None
        moved = times[(slips > SLIPPED_DEG) & (slips < final - SLIPPED_DEG)]
        arrested_s = None if first_slip_s is None else float(moved[-1] - first_slip_s) if moved.size else 0.0
        commanded_s = [at_s for at_s, output in loop.outputs if output.hold_force_n is not None]
        tightened_s = [at_s for at_s in commanded_s if at_s >= self._begun_s]
        lost = truth.dropped is not None
        return GripOutcome(
            controller=controller,
            slip_deg=max(abs(truth.slip_deg), DROPPED_DEG if lost else 0.0),
            slide_mm=max(abs(truth.slip_mm - truth.elastic_mm), DROPPED_MM if lost else 0.0),
            force_n=max(now.force_n for now in trace),
            needed_n=scenario.needed_n,
            arrested_s=arrested_s,
            tightenings=len(tightened_s),
            early=bool(tightened_s and (first_slip_s is None or tightened_s[0] < first_slip_s)),
            dropped=truth.dropped,
            fault=self.fault,
            up=scenario.event == "support gone" or truth.height_mm >= LIFT_MM - REACHED_MM,
            answered_s=self._answered_s(times, slips),
            messages=tuple(loop.messages),
        )
