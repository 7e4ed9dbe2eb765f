"""Bars of a chosen need in the closed loop of `slipguard.bench.grip`, driven by requests."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from records import changed

from slipguard.bench.grip.closed_loop import STEP_S, ClosedLoop
from slipguard.bench.grip.controllers import SlipguardController
from slipguard.bench.grip.perception_models import ModeledFinger, PerceptionErrors
from slipguard.control.control_step import ControlState
from slipguard.control.messages import ControlRequest, RequestKind, StepOutput
from slipguard.control.params import GuardParams
from slipguard.control.state import Phase
from slipguard.devices import FINGERS
from slipguard.sim.friction import SoftPad, needed_force_n
from slipguard.sim.scenario import Scenario
from slipguard.sim.sim_object import SimObject
from slipguard.sim.world import World

GRIPPER_TRIP_S = 0.004
SEEN, UNSEEN = PerceptionErrors(noise_deg=0.1, sigma_deg=0.1), PerceptionErrors(declined=True)


def bar(needed_n: float, gel: SoftPad, offset_mm: float = 100.0, friction: float = 0.8) -> SimObject:
    """A bar held at one end whose mass makes it need this force."""
    plain = SimObject(
        name="bar", split="test", height_mm=lambda u, v: np.zeros_like(u), mass_kg=1.0, com_offset_mm=offset_mm,
        inertia_kg_m2=(offset_mm * 1e-3) ** 2 / 3, friction=friction, press_mm=1.0,
    )  # fmt: skip
    return scaled(plain, needed_n, friction, gel)


def scaled(item: SimObject, needed_n: float, friction: float, gel: SoftPad) -> SimObject:
    """Return the object with this friction and the mass and inertia for which it needs this force, to 1e-9."""
    density = item.inertia_kg_m2 / item.mass_kg

    def of(mass_kg: float) -> SimObject:
        return replace(item, mass_kg=mass_kg, inertia_kg_m2=density * mass_kg, friction=friction)

    low, high = 0.0, 1.0
    while needed_force_n(of(high), gel) < needed_n:
        high *= 2.0
    while high - low > 1e-9 * high:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if needed_force_n(of(middle), gel) < needed_n else (low, middle)
    return of(high)


class Run:
    """One simulated run, step by step."""

    def __init__(
        self, world: World, params: GuardParams, seed: int = 0, without_estimate: tuple[str, ...] = ()
    ) -> None:
        self.world, self.controller = world, SlipguardController(params)
        sights = {
            name: ModeledFinger(UNSEEN if name in without_estimate else SEEN, np.random.default_rng([seed, k]))
            for k, name in enumerate(FINGERS)
        }
        self.loop = ClosedLoop(world, self.controller, sights, np.random.default_rng(seed), trip_s=GRIPPER_TRIP_S)

    def step(self, request: ControlRequest | None = None) -> None:
        if request is not None:
            self.loop.ask(request)
        self.loop.wait(STEP_S)

    def until(self, done: Callable[[], bool], limit_s: float) -> bool:
        return self.loop.until(done, limit_s)

    @property
    def now_s(self) -> float:
        return self.loop.now_s

    @property
    def commands(self) -> list[tuple[float, StepOutput]]:
        return self.loop.outputs

    @property
    def says(self) -> list[str]:
        return self.loop.messages

    @property
    def peak_deg(self) -> float:
        return max(abs(truth.rotation_deg) for truth in self.loop.trace)

    @property
    def phase(self) -> Phase:
        return self.controller.state.grasp.phase

    @property
    def guard(self) -> ControlState:
        return self.controller.state

    @guard.setter
    def guard(self, guard: ControlState) -> None:
        self.controller.state = guard


def placed(
    item: SimObject, scenario: Scenario, params: GuardParams, seed: int = 0, without_estimate: tuple[str, ...] = ()
) -> Run:
    """A run with the object between the open jaws."""
    world = World(seed=seed, lookup=lambda name: item)
    run = Run(world, params, seed, without_estimate)
    world.place(changed(scenario, object_name=item.name), run.now_s)
    return run


def grasp_and_lift(run: Run, *, guarded: bool = True, hold_s: float = 1.0) -> Run:
    """Grasp, lift, hold for a while."""
    if not guarded:
        run.step(ControlRequest(RequestKind.GUARD_OFF))
    run.step(ControlRequest(RequestKind.GRASP))
    ready = lambda: run.phase is Phase.HOLDING and not run.world.gripper_state(run.now_s).moving  # noqa: E731
    run.until(lambda: run.phase not in (Phase.CLOSING, Phase.REFERENCE), 8.0)
    run.until(ready, 4.0)
    run.until(lambda: False, 0.1)
    run.step(ControlRequest(RequestKind.LIFT))
    run.until(lambda: run.phase in (Phase.HOLDING, Phase.FAULT), 15.0)
    run.until(lambda: False, hold_s)
    return run
