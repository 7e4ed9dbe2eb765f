"""Ten minutes of holding a drawn contact, in which all acts that could drift: relief, keys, skipping, noise, light."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from slipguard.devices import Frame
from slipguard.perception.settings import PerceptionSettings
from slipguard.sim.catalogue import find_object
from slipguard.sim.gel_camera import GelCamera
from slipguard.sim.gel_view import GelView
from slipguard.sim.sensor_unit import LightChange, random_unit
from slipguard.stress.drift import DRIFT_DEG
from slipguard.stress.family import FamilyResults, TrialFamily, TrialFunction
from slipguard.stress.product_functions import FRAME_S, ProductFunctions

HOLDING = "drift of the whole pipeline"
OBJECTS = ("coin", "key")
"""Round with a texture, and with an axis; both are pressed until they look unlike their reference, and take a key."""
HELD_FRAMES = 36_000
"""Ten minutes of each."""
CYCLE_FRAMES = 600
"""In ten seconds the force rises, rests, falls and rests again: long enough for frames to be left out."""
MOVING_FRAMES = 60
TRIAL_FRAMES = 20
SHARES = (0.3, 1.1)
"""The press at either end, of the object's at 40 N."""
SHEAR_MM = 1.2
LIGHT_LEVELS, LIGHT_PERIOD_S = 3.0, 240.0
UNIT_SEED = 8100


@dataclass(slots=True)
class _HeldContact:
    """One contact. rotations_deg: of the cycle under way. first_deg: mean of the first whole cycle."""

    name: str
    camera: GelCamera
    pipeline: Any
    frame: int = 0
    rotations_deg: list[float] = field(default_factory=list)
    first_deg: float | None = None

    def image(self) -> Frame:
        """The next frame; the object does not turn, whatever else changes."""
        now_s = self.frame * FRAME_S
        if self.frame % 60 == 0:
            level = LIGHT_LEVELS * math.sin(2.0 * math.pi * now_s / LIGHT_PERIOD_S)
            self.camera.set_light(LightChange(1.0, (level, -0.5 * level, 0.7 * level)))
        part = _pressed(self.frame % CYCLE_FRAMES)
        depth_mm = find_object(self.name).press_mm * (SHARES[0] + part * (SHARES[1] - SHARES[0]))
        view = GelView(self.name, 0.4, -0.3 - SHEAR_MM * part, 25.0, depth_mm)
        self.frame += 1
        return Frame(self.camera.draw(view), now_s, self.frame)


def _pressed(at: int) -> float:
    """How far the force has risen, 0 to 1, at this frame of a cycle."""
    half = CYCLE_FRAMES // 2
    risen = min((at % half) / MOVING_FRAMES, 1.0)
    risen = risen * risen * (3.0 - 2.0 * risen)
    return risen if at < half else 1.0 - risen


def _begin(product: ProductFunctions) -> TrialFunction:
    segmenter = product.segmenter()
    held = []
    for number, name in enumerate(OBJECTS):
        camera = GelCamera(random_unit(np.random.default_rng(UNIT_SEED + number)), seed=UNIT_SEED + number)
        unit = camera.unit
        pipeline = product.pipeline(
            segmenter, PerceptionSettings(), camera.no_contact(), unit.noise_bgr, unit.px_per_mm
        )
        held.append(_HeldContact(name, camera, pipeline))

    def trial(rng: np.random.Generator, seed: int, results: FamilyResults) -> None:
        one = held[seed % len(held)]
        for _ in range(TRIAL_FRAMES):
            answer = results.call("pipeline", one.pipeline.process, one.image())
            if answer is None:
                return
            results.check_angle(one.name, answer.angle_deg, answer.sigma_deg, 0.0, axial=False)
            if answer.angle_deg is not None and math.isfinite(answer.angle_deg):
                one.rotations_deg.append(answer.angle_deg)
            if one.frame % CYCLE_FRAMES == 0 and one.rotations_deg:
                mean = float(np.mean(one.rotations_deg))
                one.rotations_deg.clear()
                one.first_deg = mean if one.first_deg is None else one.first_deg
                results.check_limit(HOLDING, abs(mean - one.first_deg), DRIFT_DEG)

    return trial


HOLD = TrialFamily(
    "holding",
    "a coin and a key drawn and held, ten minutes each, while force, shear and light come and go",
    len(OBJECTS) * HELD_FRAMES // TRIAL_FRAMES,
    50.0,
    _begin,
    TRIAL_FRAMES,
    continuous=True,
    min_answered_share=0.8,
)
