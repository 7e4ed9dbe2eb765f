"""What a trial and a hold have in common: the world with the object in it, and the first grip."""

from __future__ import annotations

import numpy as np

from slipguard.bench.grip.error_model import ERRORS
from slipguard.bench.grip.loop import Loop
from slipguard.bench.grip.modeled_perception import Drift, ModelSight, SightError
from slipguard.bench.grip.trials import ROOM_MM, Trial
from slipguard.control.messages import ControlRequest, RequestKind
from slipguard.sim.world import World, WorldSettings

START_S = 100.0
CLOSING_MAX_S = 6.0


def world_of(trial: Trial, step_s: float = 1e-3) -> World:
    """The object lies between jaws that are a little wider."""
    settings = WorldSettings(step_s=step_s, start_width_mm=trial.item.width_mm + ROOM_MM)
    world = World(settings, seed=trial.number, lookup=lambda name: trial.item)
    world.place(trial.scenario, START_S)
    return world


def model_sight(trial: Trial, finger: int, drift: Drift | None = None) -> ModelSight:
    """A finger that errs as the shipped pipeline does on this object."""
    error = ERRORS.get(trial.item.name, SightError())
    return ModelSight(error, np.random.default_rng([trial.number, finger]), drift)


def chances(trial: Trial) -> np.random.Generator:
    """Of lost frames and inexact stamps: the same for everybody who plays the trial."""
    return np.random.default_rng([trial.number, 9])


def grip(loop: Loop, force_n: float) -> None:
    """Close the jaws and wait until they are firm; the cameras look from then on."""
    loop.looking = False
    loop.ask(ControlRequest(RequestKind.GRASP, force_n=force_n))

    def firm() -> bool:
        state = loop.world.gripper_state(loop.now_s)
        return state.holding and not state.moving

    assert loop.until(firm, CLOSING_MAX_S), "the jaws did not close"
    loop.looking = True
