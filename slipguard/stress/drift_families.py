"""Trial families over long sequences: the estimated rotation must not drift."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np

from slipguard.devices import FRAME_HEIGHT_PX, FRAME_WIDTH_PX, Frame
from slipguard.perception.settings import PerceptionSettings
from slipguard.sim.catalogue import find_object
from slipguard.sim.gel_camera import GelCamera
from slipguard.sim.gel_view import GelView
from slipguard.sim.sensor_unit import LightChange, random_unit
from slipguard.stress.product_functions import FRAME_S, ProductFunctions, ScriptedPipeline
from slipguard.stress.textured_surfaces import LEVEL, Heights, LedLights, contact_map, heights, lettered, shaded_image
from slipguard.stress.trial_family import FamilyResults, TrialFamily, TrialFunction

DRIFT = "drift of a swinging texture"
HOLDING = "drift of a held object"
DRIFT_DEG = 0.1
SWING_FRAMES = 120
"""Period of the swing, which crosses every multiple of 90 degrees; also the frames of one trial."""
SWING_DEG = 200.0
NOISE_LEVELS = 1.0
CENTER_PX = (119.5, 159.5)
BACKGROUND = np.full((FRAME_HEIGHT_PX, FRAME_WIDTH_PX, 3), round(LEVEL), np.uint8)

OBJECTS = ("coin", "key")
"""Round with texture, and with an axis. Both are pressed until they differ from their reference."""
HELD_FRAMES = 36_000
"""Ten minutes of each object."""
CYCLE_FRAMES = 600
"""In ten seconds the force rises, rests, falls and rests: long enough for frames to be skipped."""
MOVING_FRAMES = 60
TRIAL_FRAMES = 20
DEPTH_SHARES = (0.3, 1.1)
"""Smallest and largest depth, as a share of the object's depth at 40 N."""
SHEAR_MM = 1.2
LIGHT_LEVELS, LIGHT_PERIOD_S = 3.0, 240.0
UNIT_SEED = 8100


def _begin_drift(product: ProductFunctions) -> TrialFunction:
    pipeline = ScriptedPipeline(product, background=BACKGROUND)

    @cache
    def height(rotation_deg: int) -> Heights:
        return heights(lettered, float(rotation_deg), CENTER_PX, 1.0)

    def trial(rng: np.random.Generator, seed: int, results: FamilyResults) -> None:
        errors = []
        for frame in range(SWING_FRAMES):
            truth_deg = round(SWING_DEG * math.sin(2.0 * math.pi * frame / SWING_FRAMES))
            shown = height(truth_deg)
            image = shaded_image(shown, LedLights(), NOISE_LEVELS, rng)
            estimate = results.call("pipeline", pipeline.process, contact_map(shown), image)
            if estimate is None:
                return
            error = results.check_rotation("pipeline", estimate, float(truth_deg))
            if error is not None and estimate.rotation_deg is not None:
                errors.append(estimate.rotation_deg - truth_deg)
        if errors:
            results.check_limit(DRIFT, abs(float(np.mean(errors))), DRIFT_DEG)

    return trial


@dataclass(slots=True)
class _HeldObject:
    """An object that is held. rotations_deg: estimates of the current cycle. first_deg: mean of the first cycle."""

    name: str
    camera: GelCamera
    pipeline: Any
    frame: int = 0
    rotations_deg: list[float] = field(default_factory=list)
    first_deg: float | None = None

    def next_frame(self) -> Frame:
        """Return the next frame. The object does not rotate while force, shear and light change."""
        now_s = self.frame * FRAME_S
        if self.frame % 60 == 0:
            level = LIGHT_LEVELS * math.sin(2.0 * math.pi * now_s / LIGHT_PERIOD_S)
            self.camera.set_light(LightChange(1.0, (level, -0.5 * level, 0.7 * level)))
        force = _force_share(self.frame % CYCLE_FRAMES)
        depth_mm = find_object(self.name).press_mm * (DEPTH_SHARES[0] + force * (DEPTH_SHARES[1] - DEPTH_SHARES[0]))
        view = GelView(self.name, 0.4, -0.3 - SHEAR_MM * force, 25.0, depth_mm)
        self.frame += 1
        return Frame(self.camera.draw(view), now_s, self.frame)


def _force_share(frame: int) -> float:
    """Return the force at a frame of the cycle, from 0 to 1."""
    half = CYCLE_FRAMES // 2
    risen = min((frame % half) / MOVING_FRAMES, 1.0)
    risen = risen * risen * (3.0 - 2.0 * risen)
    return risen if frame < half else 1.0 - risen


def _begin_holding(product: ProductFunctions) -> TrialFunction:
    segmenter = product.segmenter()
    held = []
    for number, name in enumerate(OBJECTS):
        camera = GelCamera(random_unit(np.random.default_rng(UNIT_SEED + number)), seed=UNIT_SEED + number)
        sensor = (camera.no_contact(), camera.unit.noise_bgr, camera.unit.px_per_mm)
        held.append(_HeldObject(name, camera, product.pipeline(segmenter, PerceptionSettings(), *sensor)))

    def trial(rng: np.random.Generator, seed: int, results: FamilyResults) -> None:
        one = held[seed % len(held)]
        for _ in range(TRIAL_FRAMES):
            estimate = results.call("pipeline", one.pipeline.process, one.next_frame())
            if estimate is None:
                return
            results.check_angle(one.name, estimate.rotation_deg, estimate.sigma_deg, 0.0, axial=False)
            if estimate.rotation_deg is not None and math.isfinite(estimate.rotation_deg):
                one.rotations_deg.append(estimate.rotation_deg)
            if one.frame % CYCLE_FRAMES == 0 and one.rotations_deg:
                mean = float(np.mean(one.rotations_deg))
                one.rotations_deg.clear()
                one.first_deg = mean if one.first_deg is None else one.first_deg
                results.check_limit(HOLDING, abs(mean - one.first_deg), DRIFT_DEG)

    return trial


DRIFTING = TrialFamily(
    "drift", "a texture that swings across ±90° and ±180° through the whole pipeline", 1_000, 900.0, _begin_drift,
    SWING_FRAMES, continuous=True, min_answered_share=0.95,
)  # fmt: skip
HOLD = TrialFamily(
    "holding", "a coin and a key held for ten minutes each while force, shear and light change",
    len(OBJECTS) * HELD_FRAMES // TRIAL_FRAMES, 50.0, _begin_holding, TRIAL_FRAMES, continuous=True,
    min_answered_share=0.8,
)  # fmt: skip
