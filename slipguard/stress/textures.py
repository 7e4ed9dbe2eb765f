"""Reliefs turned, shifted and pressed harder under lights that stay: followed, or declined where they are round.

And turned while nobody looks, as fast as things begin to fall: teeth and nuts have then lost their count.
"""

from __future__ import annotations

import numpy as np

from slipguard.perception.rotation.period import ACCELERATION_DEG_S2
from slipguard.stress.family import FamilyResults, TrialFamily, TrialFunction
from slipguard.stress.light import SPOILS, nonsense
from slipguard.stress.product_functions import FRAME_S, ProductFunctions, ScriptedImagePipeline
from slipguard.stress.surfaces import (
    LEVEL,
    LedLights,
    Surface,
    ball,
    contact,
    drawn,
    gear,
    heights,
    lettered,
    nut,
    plate,
    ring,
)

NOISES = (0.0, 1.0, 2.0, 4.0, 8.0, 16.0)
STEP_DEG = 4.0
TELLING: tuple[Surface, ...] = (lettered, plate, gear)
ROUND: tuple[Surface, ...] = (ball, ring)
HELD_FRAMES = 6
LEFT: tuple[Surface, ...] = (gear, nut, lettered, plate)
LEFT_S = (2.0 * FRAME_S, 0.05, 0.1, 0.25, 0.5, 2.0)
LEFT_MAX_DEG = 80.0
"""Beyond a right angle an axis is another turn's."""


def _lights(rng: np.random.Generator) -> LedLights:
    """Lights as they differ from unit to unit, some in the other sense of rotation."""
    azimuths = np.array([270.0, 150.0, 30.0]) + rng.normal(0.0, 8.0, 3)
    if rng.random() < 0.25:
        azimuths = 180.0 - azimuths
    b, g, r = rng.uniform(0.6, 1.4, 3)
    right, up = rng.uniform(-0.3, 0.3, 2)
    return LedLights((b, g, r), (float(azimuths[0]), float(azimuths[1]), float(azimuths[2])), (right, up))


def _begin(product: ProductFunctions) -> TrialFunction:
    background = np.full((320, 240, 3), round(LEVEL), np.uint8)

    def trial(rng: np.random.Generator, seed: int, results: FamilyResults) -> None:
        seed, kind = divmod(seed, 5)
        finger = ScriptedImagePipeline(product, background)
        lights, noise = _lights(rng), NOISES[seed % len(NOISES)]
        at = (float(rng.uniform(90, 150)), float(rng.uniform(110, 210)))
        start = float(rng.uniform(-180, 180))
        if kind == 3:
            _spoiled(finger, lights, noise, at, start, rng, results)
            return
        if kind == 4:
            _left(finger, LEFT[seed % len(LEFT)], lights, noise, at, start, rng, results)
            return
        surface = TELLING[seed % len(TELLING)] if kind < 2 else ROUND[seed % len(ROUND)]
        way = float(rng.choice((-1.0, 1.0)))
        steps = int(rng.integers(2, 9))
        shift_x, shift_y = rng.uniform(-14, 14, 2)
        grown = float(rng.uniform(0.85, 1.7))
        error: float | None = None
        for k in range(steps + 1):
            part = k / steps
            there = (at[0] + part * shift_x, at[1] + part * shift_y)
            height = heights(surface, start + way * STEP_DEG * k, there, 1.0 + part * (grown - 1.0))
            answer = results.call("pipeline", finger.see, drawn(height, lights, noise, rng), contact(height))
            if answer is None:
                return
            results.check_finite("pipeline", answer.orientation_deg, answer.rate_deg_s, *(answer.shift_mm or ()))
            truth = None if kind == 2 else way * STEP_DEG * k
            error = results.check_angle(surface.__name__, answer.angle_deg, answer.sigma_deg, truth, axial=False)
        if kind < 2:
            results.add_curve_point("relief noise/pipeline", noise, error)

    return trial


def _spoiled(
    finger: ScriptedImagePipeline, lights: LedLights, noise: float, at: tuple[float, float], start: float,
    rng: np.random.Generator, results: FamilyResults,
) -> None:  # fmt: skip
    """Held still while the picture goes bad, over the network's head: no confident turn comes of it."""
    height = heights(lettered, start, at, 1.0)
    spoil = list(SPOILS.values())[int(rng.integers(len(SPOILS)))]
    strength = float(rng.uniform(0.0, 1.0))
    for k in range(HELD_FRAMES):
        image = drawn(height, lights, noise, rng)
        if k >= 2:
            image = nonsense(rng) if k == HELD_FRAMES - 1 else spoil(image, strength, rng)
        answer = results.call("pipeline, spoiled", finger.see, image, contact(height))
        if answer is not None:
            results.check_angle("pipeline, spoiled", answer.angle_deg, answer.sigma_deg, 0.0, axial=False)


def _left(
    finger: ScriptedImagePipeline, surface: Surface, lights: LedLights, noise: float, at: tuple[float, float], start: float,
    rng: np.random.Generator, results: FamilyResults,
) -> None:  # fmt: skip
    """Held still, out of sight, and turned meanwhile by up to what can fall: told, or the count is known to be lost."""
    gap_s = float(rng.choice(LEFT_S))
    rotation = float(rng.uniform(-1.0, 1.0)) * min(0.5 * ACCELERATION_DEG_S2 * gap_s**2, LEFT_MAX_DEG)
    for k in range(HELD_FRAMES):
        truth = 0.0 if k < 2 else rotation
        height = heights(surface, start + truth, at, 1.0)
        image = drawn(height, lights, noise, rng)
        answer = results.call("pipeline", finger.see, image, contact(height), gap_s if k == 2 else FRAME_S)
        if answer is None:
            return
        results.check_angle(f"{surface.__name__}, left", answer.angle_deg, answer.sigma_deg, truth, axial=False)


TEXTURES = TrialFamily(
    "relief",
    "reliefs turned, grown, shifted, spoiled and left unseen under lights that stay",
    6_000,
    100.0,
    _begin,
    min_answered_share=0.45,
)
