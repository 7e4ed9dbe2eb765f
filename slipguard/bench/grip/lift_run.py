"""Sets up and runs one scenario with one controller on one plant."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np

from slipguard.bench.grip.closed_loop import ClosedLoop, FingerModel
from slipguard.bench.grip.controllers import (
    Clairvoyant,
    FixedStep,
    NaiveSteps,
    ProportionalSteps,
    Reactive,
    SlipguardController,
    UnguardedController,
)
from slipguard.bench.grip.lift_course import GripOutcome, LiftCourse
from slipguard.bench.grip.perception_models import (
    PERCEPTION_ERRORS,
    ModeledFinger,
    RenderedFinger,
    RotationDrift,
)
from slipguard.bench.grip.scenarios import PERCEIVING_S, ROOM_MM, GripScenario, earlier_grasps
from slipguard.control.messages import ControlRequest, RequestKind
from slipguard.control.params import GuardParams
from slipguard.control.state import Phase
from slipguard.devices import FINGERS
from slipguard.sim import object_motion
from slipguard.sim.mujoco_plant import MujocoPlant
from slipguard.sim.world import World, WorldSettings

PlantName = Literal["own", "mujoco"]
CONSTANTS = (0.15, 0.2, 0.25, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
"""Constant forces, relative to the force limit; at least what the gripper's weakest grip is."""
EARLIER_GRASPS = 2
"""slipguard has gripped other objects with the same pads before: it learns their stiffness. A start is rarer."""
START_S = 100.0
STEP_S = 2e-3
RELEASE_MAX_S = 5.0
DRIFT_DEG, DRIFT_S = 0.15, (20.0, 60.0)


def run_lift(
    scenario: GripScenario,
    controller: str,
    plant: PlantName = "own",
    *,
    hold_s: float = 0.0,
    rendered: bool = False,
    params: GuardParams | None = None,
) -> GripOutcome:
    """Run a scenario; equal arguments give equal outcomes.

    Args:
        controller: "slipguard", "no guard", "naive steps", "proportional steps", "fixed step", "clairvoyant",
            "reactive", or "constant 0.30".
        hold_s: Duration of taps, shaking and arm motions after the event.
        rendered: With rendered frames and the shipped pipeline instead of the error model.
    """
    params = guard_params(params or GuardParams(), scenario)
    decides = _controller(controller, params, scenario)
    start_s = START_S
    if isinstance(decides, SlipguardController):
        for other in earlier_grasps(scenario, EARLIER_GRASPS):
            start_s = _earlier(other, decides, plant, start_s)
    rng = np.random.default_rng([scenario.seed, scenario.number, 17])
    fingers = _fingers(scenario, rng, drifts=hold_s > 0.0, rendered=rendered)
    loop_rng = np.random.default_rng([scenario.seed, scenario.number, 9])
    run = LiftCourse(scenario, _loop(scenario, plant, decides, fingers, loop_rng, start_s))
    run.grip(constant_n(controller, scenario))
    run.lift()
    run.event()
    if hold_s > 0.0:
        run.hold(rng, hold_s)
    return run.outcome(controller)


def _earlier(scenario: GripScenario, controller: SlipguardController, plant: PlantName, start_s: float) -> float:
    """Grip, lift and release an object; return the time afterwards."""
    rng = np.random.default_rng([scenario.seed, scenario.number, 29])
    fingers = _fingers(scenario, rng, drifts=False, rendered=False)
    loop = _loop(scenario, plant, controller, fingers, rng, start_s)
    run = LiftCourse(scenario, loop)
    run.grip(scenario.first_n)
    run.lift()
    loop.ask(ControlRequest(RequestKind.RELEASE))
    loop.until(lambda: controller.state.grasp.phase is Phase.IDLE, RELEASE_MAX_S)
    return loop.now_s


def constant_n(controller: str, scenario: GripScenario) -> float:
    """Return the force of the first grip as commanded: the scenario's, or that of a constant."""
    if not controller.startswith("constant "):
        return scenario.first_n
    gripper = scenario.pose.gripper
    return max(float(controller.removeprefix("constant ")) * scenario.force_max_n, gripper.force_min_n)


def guard_params(params: GuardParams, scenario: GripScenario) -> GuardParams:
    """Return the parameters with the scenario's force limit."""
    limit_n = scenario.force_max_n
    changed = {
        "force_max_n": limit_n,
        "first_force_n": min(params.first_force_n, limit_n),
        "no_estimate_force_n": min(params.no_estimate_force_n, limit_n),
    }
    return GuardParams.model_validate(params.model_dump() | changed)


def _loop(
    scenario: GripScenario,
    plant: PlantName,
    controller: SlipguardController | UnguardedController,
    fingers: dict[str, FingerModel],
    rng: np.random.Generator,
    start_s: float,
) -> ClosedLoop:
    gripper = scenario.pose.gripper
    return ClosedLoop(
        _world(scenario, plant, start_s),
        controller,
        fingers,
        rng,
        PERCEIVING_S,
        now_s=start_s,
        gripper_limits_n=(gripper.force_min_n, gripper.force_max_n),
    )


def _world(scenario: GripScenario, plant: PlantName, start_s: float) -> World:
    item = scenario.item
    world = World(
        WorldSettings(step_s=STEP_S, start_width_mm=item.width_mm + ROOM_MM),
        seed=scenario.number,
        lookup=lambda name: item,
        mechanics=MujocoPlant() if plant == "mujoco" else object_motion.advance,
    )
    world.place(scenario.pose, start_s)
    return world


def _controller(name: str, params: GuardParams, scenario: GripScenario) -> SlipguardController | UnguardedController:
    if name == "slipguard":
        return SlipguardController(params)
    if name == "proportional steps":
        return ProportionalSteps(force_max_n=params.force_max_n)
    if name == "naive steps":
        return NaiveSteps(force_max_n=params.force_max_n)
    if name == "fixed step":
        return FixedStep(force_max_n=params.force_max_n)
    if name == "reactive":
        return Reactive(delay_s=scenario.pose.left.latency_s + PERCEIVING_S)
    return Clairvoyant() if name == "clairvoyant" else UnguardedController()


def _fingers(
    scenario: GripScenario, rng: np.random.Generator, *, drifts: bool, rendered: bool
) -> dict[str, FingerModel]:
    if rendered:
        cameras = (scenario.pose.left, scenario.pose.right)
        return {f: RenderedFinger(2 * scenario.number + k, cameras[k]) for k, f in enumerate(FINGERS)}
    error = PERCEPTION_ERRORS[scenario.pose.object_name]
    phase, period_s = float(rng.uniform(0.0, 2.0 * math.pi)), float(rng.uniform(*DRIFT_S))
    drift = RotationDrift(DRIFT_DEG if drifts else 0.0, period_s, phase)
    seeds = [[scenario.seed, scenario.number, k] for k in range(len(FINGERS))]
    return {f: ModeledFinger(error, np.random.default_rng(seeds[k]), drift) for k, f in enumerate(FINGERS)}
