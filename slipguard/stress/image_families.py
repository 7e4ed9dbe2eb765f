"""Trial families on images: distorted rendered grasps, and textured surfaces that rotate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, cast

import numpy as np

from slipguard.devices import Frame
from slipguard.perception.rotation.period import ACCELERATION_DEG_S2
from slipguard.perception.settings import PerceptionSettings
from slipguard.sim.catalogue import find_object, object_names
from slipguard.sim.gel_camera import GelCamera
from slipguard.sim.gel_view import GelView
from slipguard.sim.sensor_unit import SensorUnit
from slipguard.stress.image_distortions import SPOILS, Image, malformed, nonsense
from slipguard.stress.product_functions import FRAME_S, PX_PER_MM, ProductFunctions, ScriptedImagePipeline
from slipguard.stress.textured_surfaces import (
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
from slipguard.stress.trial_family import FamilyResults, TrialFamily, TrialFunction

NoiseBgr = tuple[float, float, float]

GRASPS = 24
STILL_FRAMES, ROTATED_FRAMES = 6, 5
STEP_DEG = 4.0
NOISE_LEVELS = (0.0, 2.0, 4.0, 8.0, 16.0, 32.0)
STRENGTHS = (0.03, 0.06, 0.12, 0.25, 0.5, 0.75, 1.0)


@dataclass(frozen=True, slots=True, eq=False)
class RotatedGrasp:
    """One object held still and then turned by `STEP_DEG` a frame."""

    background: Image
    noise_bgr: NoiseBgr
    frames: tuple[Image, ...]
    rotations_deg: tuple[float, ...]


@cache
def grasp(number: int) -> RotatedGrasp:
    """The same grasp for the same number: an object with an axis, anywhere, pressed lightly or hard."""
    rng = np.random.default_rng(np.random.SeedSequence([number, 77]))
    things = [find_object(name) for name in object_names("train")]
    readable = [thing for thing in things if thing.axial]
    thing = readable[number % len(readable)]
    camera = GelCamera(SensorUnit.default(), seed=number)
    x, y, start = rng.uniform(-2, 2), rng.uniform(-3, 3), rng.uniform(-180, 180)
    depth = thing.press_mm * rng.uniform(0.5, 1.0)
    way = float(rng.choice((-1.0, 1.0)))
    rotations = [0.0] * STILL_FRAMES + [way * STEP_DEG * (k + 1) for k in range(ROTATED_FRAMES)]
    frames = [camera.draw(GelView(thing.name, x, y, start + rotation, depth)) for rotation in rotations]
    return RotatedGrasp(camera.no_contact(), camera.unit.noise_bgr, tuple(frames), tuple(rotations))


def _begin_images(product: ProductFunctions) -> TrialFunction:
    segmenter = product.segmenter()
    spoils = list(SPOILS.items())
    settings = PerceptionSettings()

    def pipeline(background: Image | None, noise_bgr: NoiseBgr | None, results: FamilyResults) -> Any:
        """A new pipeline, or None where it refuses a spoiled no-contact image."""
        return results.call("pipeline", product.pipeline, segmenter, settings, background, noise_bgr, PX_PER_MM)

    def trial(rng: np.random.Generator, seed: int, results: FamilyResults) -> None:
        kind, seed = seed % 4, seed // 4
        shown = grasp(int(rng.integers(GRASPS)))
        noise_bgr: NoiseBgr | None = shown.noise_bgr
        if kind == 0:
            level = NOISE_LEVELS[seed % len(NOISE_LEVELS)]
            spoiled = [SPOILS["noise"](image, level / 64.0, rng) for image in shown.frames]
            error = _watch(
                pipeline(shown.background, noise_bgr, results), spoiled, shown.rotations_deg, results, "noise"
            )
            results.add_curve_point("frame noise/pipeline", level, error)
            return
        name, spoil = spoils[seed % len(spoils)]
        strength = STRENGTHS[seed // len(spoils) % len(STRENGTHS)]
        draw = int(rng.integers(2**31))  # the same in every frame: a state of the sensor, not a flicker
        frames = [spoil(image, strength, np.random.default_rng(draw)) for image in shown.frames]
        background: Image | None = shown.background
        if kind == 1:  # from the calibration on, which measures the noise too
            background = spoil(shown.background, strength, np.random.default_rng(draw))
            noise_bgr = _measured_noise(frames[:STILL_FRAMES])
        elif kind == 2:  # since the reference was taken
            frames[:STILL_FRAMES] = shown.frames[:STILL_FRAMES]
        elif rng.random() < 0.5:  # in each frame anew
            frames = [spoil(image, strength, rng) for image in shown.frames]
        else:  # not calibrated at all
            background = noise_bgr = None
        _watch(pipeline(background, noise_bgr, results), frames, shown.rotations_deg, results, name)
        if rng.random() < 0.25:
            _look_at_nonsense(pipeline(shown.background, noise_bgr, results), shown, rng, results)

    return trial


def _measured_noise(still: Sequence[Image]) -> NoiseBgr:
    """As the calibration measures it: neighbouring frames differ by the noise alone."""
    b, g, r = np.diff(np.stack(still).astype(np.float32), axis=0).std(axis=(0, 1, 2)) / np.sqrt(2.0)
    return float(b), float(g), float(r)


def _watch(
    pipeline: Any, frames: Sequence[Image], rotations_deg: Sequence[float], results: FamilyResults, label: str
) -> float | None:
    """Feed frames and judge every answer against the turn since the reference; the last one's error, None: declined."""
    error = None
    since_deg: float | None = None
    if pipeline is None:
        return None
    for k, (image, truth) in enumerate(zip(frames, rotations_deg, strict=True)):
        answer = results.call(f"pipeline, {label}", pipeline.process, Frame(image, k * FRAME_S, k))
        if since_deg is None and pipeline.has_reference:
            since_deg = truth
        error = None
        if answer is not None:
            rotation = truth - (since_deg or 0.0)
            results.check_finite("pipeline", answer.orientation_deg, answer.rate_deg_s, *(answer.shift_mm or ()))
            error = results.check_angle(f"pipeline, {label}", answer.angle_deg, answer.sigma_deg, rotation, axial=False)
    return error


def _look_at_nonsense(pipeline: Any, shown: RotatedGrasp, rng: np.random.Generator, results: FamilyResults) -> None:
    """After a reference: pictures of nothing and things that are no pictures; no turn may be claimed."""
    if pipeline is None:
        return
    for k in range(STILL_FRAMES):
        results.call("pipeline", pipeline.process, Frame(shown.frames[k], k * FRAME_S, k))
    for k in range(STILL_FRAMES, STILL_FRAMES + 4):
        image = nonsense(rng) if k % 2 else cast(Image, malformed(rng))
        answer = results.call("pipeline, no picture", pipeline.process, Frame(image, k * FRAME_S, k))
        if answer is not None:
            results.check_angle("pipeline, no picture", answer.angle_deg, answer.sigma_deg, None, axial=False)


IMAGES = TrialFamily(
    "pictures",
    "extreme light, hot pixels, saturated frames, swapped colours, nonsense",
    10_000,
    85.0,
    _begin_images,
    min_answered_share=0.3,
)


NOISES = (0.0, 1.0, 2.0, 4.0, 8.0, 16.0)
TEXTURE_STEP_DEG = 4.0
TELLING: tuple[Surface, ...] = (lettered, plate, gear)
ROUND: tuple[Surface, ...] = (ball, ring)
TEXTURE_FRAMES = 6
LEFT: tuple[Surface, ...] = (gear, nut, lettered, plate)
LEFT_S = (2.0 * FRAME_S, 0.05, 0.1, 0.25, 0.5, 2.0)
LEFT_MAX_DEG = 80.0
"""Beyond a right angle an axis is another turn's."""


def _random_lights(rng: np.random.Generator) -> LedLights:
    """Lights as they differ from unit to unit, some in the other sense of rotation."""
    azimuths = np.array([270.0, 150.0, 30.0]) + rng.normal(0.0, 8.0, 3)
    if rng.random() < 0.25:
        azimuths = 180.0 - azimuths
    b, g, r = rng.uniform(0.6, 1.4, 3)
    right, up = rng.uniform(-0.3, 0.3, 2)
    return LedLights((b, g, r), (float(azimuths[0]), float(azimuths[1]), float(azimuths[2])), (right, up))


def _begin_textures(product: ProductFunctions) -> TrialFunction:
    background = np.full((320, 240, 3), round(LEVEL), np.uint8)

    def trial(rng: np.random.Generator, seed: int, results: FamilyResults) -> None:
        seed, kind = divmod(seed, 5)
        finger = ScriptedImagePipeline(product, background)
        lights, noise = _random_lights(rng), NOISES[seed % len(NOISES)]
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
            height = heights(surface, start + way * TEXTURE_STEP_DEG * k, there, 1.0 + part * (grown - 1.0))
            answer = results.call("pipeline", finger.see, drawn(height, lights, noise, rng), contact(height))
            if answer is None:
                return
            results.check_finite("pipeline", answer.orientation_deg, answer.rate_deg_s, *(answer.shift_mm or ()))
            truth = None if kind == 2 else way * TEXTURE_STEP_DEG * k
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
    for k in range(TEXTURE_FRAMES):
        image = drawn(height, lights, noise, rng)
        if k >= 2:
            image = nonsense(rng) if k == TEXTURE_FRAMES - 1 else spoil(image, strength, rng)
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
    for k in range(TEXTURE_FRAMES):
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
    _begin_textures,
    min_answered_share=0.45,
)
