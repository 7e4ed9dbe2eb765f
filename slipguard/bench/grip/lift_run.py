"""Sets up and runs one scenario with one controller on one plant."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np

from slipguard.bench.grip.closed_loop import ClosedLoop, FingerModel
from slipguard.bench.grip.controllers import (
    Clairvoyant,
    FixedStep,
    NaiveSteps,
    Reactive,
    SlipguardController,
    UnguardedController,
)
from slipguard.bench.grip.lift_course import GripOutcome, LiftCourse
from slipguard.bench.grip.perception_models import ModeledFinger, PerceptionErrors, RenderedFinger
from slipguard.bench.grip.scenarios import PERCEIVING_S, ROOM_MM, GripScenario
from slipguard.control.params import GuardParams
from slipguard.devices import FINGERS
from slipguard.sim import object_motion
from slipguard.sim.mujoco_plant import MujocoPlant
from slipguard.sim.world import World, WorldSettings

PlantName = Literal["own", "mujoco"]
PLANTS: tuple[PlantName, ...] = ("own", "mujoco")
NAIVE_DEG = (2.0, 1.0, 0.5, 0.25)
"""The naive law adds 10 N for each of these; the smaller ones reach slipguard's force."""
CONSTANTS = (0.3, 0.5, 0.7, 1.0)
"""Constant forces, relative to the force limit; at least what the gripper's weakest grip is."""
START_S = 100.0
STEP_S = 2e-3


def run_lift(
    scenario: GripScenario,
    controller: str,
    plant: PlantName = "own",
    *,
    disturbed: bool = False,
    rendered: bool = False,
    params: GuardParams | None = None,
) -> GripOutcome:
    """Run a scenario; equal arguments give equal outcomes.

    Args:
        controller: "slipguard", "no guard", "naive 2°", "fixed step", "clairvoyant", "reactive", or "constant 0.30".
        disturbed: Disturb the held object afterwards, and put it down.
        rendered: With rendered frames and the shipped pipeline instead of the error model.
    """
    params = guard_params(params or GuardParams(), scenario)
    decides = _controller(controller, params, scenario)
    rng = np.random.default_rng([scenario.seed, scenario.number, 17])
    fingers = _fingers(scenario, rng, rendered=rendered)
    loop_rng = np.random.default_rng([scenario.seed, scenario.number, 9])
    run = LiftCourse(scenario, _loop(scenario, plant, decides, fingers, loop_rng))
    run.grip(constant_n(controller, scenario))
    run.lift()
    run.event()
    outcome = run.outcome(controller)
    if not disturbed or outcome.dropped is not None:
        return outcome
    return replace(outcome, disturbed=run.disturb(), fault=run.fault)


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
) -> ClosedLoop:
    gripper = scenario.pose.gripper
    return ClosedLoop(
        _world(scenario, plant),
        controller,
        fingers,
        rng,
        PERCEIVING_S,
        now_s=START_S,
        gripper_limits_n=(gripper.force_min_n, gripper.force_max_n),
    )


def _world(scenario: GripScenario, plant: PlantName) -> World:
    item = scenario.item
    world = World(
        WorldSettings(step_s=STEP_S, start_width_mm=item.width_mm + ROOM_MM),
        seed=scenario.number,
        lookup=lambda name: item,
        mechanics=MujocoPlant() if plant == "mujoco" else object_motion.advance,
    )
    world.place(scenario.pose, START_S)
    return world


def _controller(name: str, params: GuardParams, scenario: GripScenario) -> SlipguardController | UnguardedController:
    if name == "slipguard":
        return SlipguardController(params)
    if name.startswith("naive "):
        return NaiveSteps(force_max_n=params.force_max_n, step_deg=float(name.removeprefix("naive ").rstrip("°")))
    if name == "fixed step":
        return FixedStep(force_max_n=params.force_max_n)
    if name == "reactive":
        return Reactive(delay_s=scenario.pose.left.latency_s + PERCEIVING_S)
    return Clairvoyant() if name == "clairvoyant" else UnguardedController()


def _fingers(scenario: GripScenario, rng: np.random.Generator, *, rendered: bool) -> dict[str, FingerModel]:
    if rendered:
        cameras = (scenario.pose.left, scenario.pose.right)
        return {f: RenderedFinger(2 * scenario.number + k, cameras[k]) for k, f in enumerate(FINGERS)}
    return {f: ModeledFinger(PerceptionErrors(), child) for f, child in zip(FINGERS, rng.spawn(2), strict=True)}
