"""Trial families on images: distorted rendered grasps, and textured surfaces that rotate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, cast

import numpy as np

from slipguard.devices import Frame
from slipguard.perception.settings import PerceptionSettings
from slipguard.sim.catalogue import find_object, object_names
from slipguard.sim.gel_camera import GelCamera
from slipguard.sim.gel_view import GelView
from slipguard.sim.sensor_unit import SensorUnit
from slipguard.stress.image_distortions import DISTORTIONS, Image, malformed, unrelated_image
from slipguard.stress.product_functions import FRAME_S, PX_PER_MM, ProductFunctions, ScriptedPipeline
from slipguard.stress.textured_surfaces import (
    LEVEL,
    Heights,
    LedLights,
    Surface,
    ball,
    contact_map,
    gear,
    heights,
    lettered,
    nut,
    plate,
    ring,
    shaded_image,
    toothed,
)
from slipguard.stress.trial_family import FamilyResults, TrialFamily, TrialFunction

NoiseBgr = tuple[float, float, float]

GRASPS = 24
STILL_FRAMES, ROTATED_FRAMES = 6, 5
STEP_DEG = 4.0
NOISE_LEVELS = (0.0, 2.0, 4.0, 8.0, 16.0, 32.0)
STRENGTHS = (0.03, 0.06, 0.12, 0.25, 0.5, 0.75, 1.0)

TEXTURE_NOISE_LEVELS = (0.0, 1.0, 2.0, 4.0, 8.0, 16.0)
WITH_TEXTURE: tuple[Surface, ...] = (lettered, plate, gear)
WITHOUT_TEXTURE: tuple[Surface, ...] = (ball, ring)
TEXTURE_FRAMES = 6
UNSEEN: tuple[Surface, ...] = (gear, nut, lettered, plate)
PERIODIC: tuple[Surface, ...] = (gear, nut)
UNSEEN_S = (2.0 * FRAME_S, 0.05, 0.1, 0.25, 0.5, 2.0)
UNSEEN_MAX_DEG = 80.0
"""Beyond 90 degrees an axis is ambiguous."""
FALLS_DEG_S2 = (1_250.0, 2_500.0, 5_000.0, 10_000.0, 20_000.0, 40_000.0, 80_000.0)
"""Accelerations of falling objects: a rod of 8 cm held at its end reaches 10,000 degrees/s2 without any grip. The sweep
goes on until estimates break, which the curve shows; they must not break up to twice the fall of that rod."""
FALL_SPECIFIED_DEG_S2 = 20_000.0
TEETH = (12, 18, 24, 30, 40)
FALL_FRAMES = 8


@dataclass(frozen=True, slots=True, eq=False)
class RotatedGrasp:
    """Frames of an object that rests and then rotates by `STEP_DEG` per frame."""

    background: Image
    noise_bgr: NoiseBgr
    frames: tuple[Image, ...]
    rotations_deg: tuple[float, ...]


@cache
def rotated_grasp(number: int) -> RotatedGrasp:
    """Return a grasp of an object with an axis, at a random place and depth; a function of its number."""
    rng = np.random.default_rng(np.random.SeedSequence([number, 77]))
    with_axis = [one for one in map(find_object, object_names("train")) if one.axial]
    held = with_axis[number % len(with_axis)]
    camera = GelCamera(SensorUnit(), seed=number)
    x, y, start = rng.uniform(-2, 2), rng.uniform(-3, 3), rng.uniform(-180, 180)
    depth = held.press_mm * rng.uniform(0.5, 1.0)
    direction = float(rng.choice((-1.0, 1.0)))
    rotations = [0.0] * STILL_FRAMES + [direction * STEP_DEG * (k + 1) for k in range(ROTATED_FRAMES)]
    frames = [camera.draw(GelView(held.name, x, y, start + rotation, depth)) for rotation in rotations]
    return RotatedGrasp(camera.no_contact(), camera.unit.noise_bgr, tuple(frames), tuple(rotations))


def _begin_images(product: ProductFunctions) -> TrialFunction:
    segmenter = product.segmenter()
    distortions = list(DISTORTIONS.items())
    settings = PerceptionSettings()

    def open_pipeline(background: Image | None, noise_bgr: NoiseBgr | None, results: FamilyResults) -> Any:
        """Return a new pipeline; None if it refuses a distorted background image."""
        return results.call("pipeline", product.pipeline, segmenter, settings, background, noise_bgr, PX_PER_MM)

    def trial(rng: np.random.Generator, seed: int, results: FamilyResults) -> None:
        kind, seed = seed % 4, seed // 4
        grasp = rotated_grasp(int(rng.integers(GRASPS)))
        background: Image | None = grasp.background
        noise_bgr: NoiseBgr | None = grasp.noise_bgr
        if kind == 0:
            level = NOISE_LEVELS[seed % len(NOISE_LEVELS)]
            noisy = [DISTORTIONS["noise"](image, level / 64.0, rng) for image in grasp.frames]
            pipeline = open_pipeline(background, noise_bgr, results)
            error = _check_frames(pipeline, noisy, grasp.rotations_deg, results, "noise")
            results.add_curve_point("frame noise/pipeline", level, error)
            return
        name, distort = distortions[seed % len(distortions)]
        strength = STRENGTHS[seed // len(distortions) % len(STRENGTHS)]
        draw = int(rng.integers(2**31))  # equal in every frame: a permanent state of the sensor
        frames = [distort(image, strength, np.random.default_rng(draw)) for image in grasp.frames]
        if kind == 1:  # already distorted during calibration, which also measures the noise
            background = distort(grasp.background, strength, np.random.default_rng(draw))
            noise_bgr = _measure_noise(frames[:STILL_FRAMES])
        elif kind == 2:  # distorted after the reference was taken
            frames[:STILL_FRAMES] = grasp.frames[:STILL_FRAMES]
        elif rng.random() < 0.5:  # distorted differently in each frame
            frames = [distort(image, strength, rng) for image in grasp.frames]
        else:  # not calibrated
            background = noise_bgr = None
        _check_frames(open_pipeline(background, noise_bgr, results), frames, grasp.rotations_deg, results, name)
        if rng.random() < 0.25:
            _check_unrelated_images(open_pipeline(grasp.background, noise_bgr, results), grasp, rng, results)

    return trial


def _measure_noise(still: Sequence[Image]) -> NoiseBgr:
    """Return the noise as the calibration measures it, from differences of consecutive frames."""
    b, g, r = np.diff(np.stack(still).astype(np.float32), axis=0).std(axis=(0, 1, 2)) / np.sqrt(2.0)
    return float(b), float(g), float(r)


def _check_frames(
    pipeline: Any, frames: Sequence[Image], rotations_deg: Sequence[float], results: FamilyResults, label: str
) -> float | None:
    """Check each estimate against the rotation since the reference; return the last error, None if declined."""
    if pipeline is None:
        return None
    error = None
    reference_deg: float | None = None
    for k, (image, truth) in enumerate(zip(frames, rotations_deg, strict=True)):
        estimate = results.call(f"pipeline, {label}", pipeline.process, Frame(image, k * FRAME_S, k))
        if reference_deg is None and pipeline.has_reference:
            reference_deg = truth
        error = None
        if estimate is not None:
            error = results.check_rotation(f"pipeline, {label}", estimate, truth - (reference_deg or 0.0))
    return error


def _check_unrelated_images(
    pipeline: Any, grasp: RotatedGrasp, rng: np.random.Generator, results: FamilyResults
) -> None:
    """After a reference, process images without a gel and objects that are not images: no rotation may be estimated."""
    if pipeline is None:
        return
    for k in range(STILL_FRAMES):
        results.call("pipeline", pipeline.process, Frame(grasp.frames[k], k * FRAME_S, k))
    for k in range(STILL_FRAMES, STILL_FRAMES + 4):
        image = unrelated_image(rng) if k % 2 else cast(Image, malformed(rng))
        estimate = results.call("pipeline, no gel image", pipeline.process, Frame(image, k * FRAME_S, k))
        if estimate is not None:
            results.check_angle("pipeline, no gel image", estimate.rotation_deg, estimate.sigma_deg, None, axial=False)


@dataclass(frozen=True, slots=True)
class _TexturedContact:
    """A textured surface at `at` (x, y in frame pixels), pressed into a gel under these lights."""

    pipeline: ScriptedPipeline
    lights: LedLights
    noise: float
    at: tuple[float, float]
    start_deg: float
    rng: np.random.Generator
    results: FamilyResults

    def heights(
        self, surface: Surface, rotation_deg: float, shift_px: tuple[float, float] = (0.0, 0.0), force: float = 1.0
    ) -> Heights:
        center = (self.at[0] + shift_px[0], self.at[1] + shift_px[1])
        return heights(surface, self.start_deg + rotation_deg, center, force)

    def image(self, height: Heights) -> Image:
        return shaded_image(height, self.lights, self.noise, self.rng)

    def check(
        self, label: str, height: Heights, truth_deg: float | None, image: Image | None = None, after_s: float = FRAME_S
    ) -> float | None:
        """Process the next frame and check its estimate; return its error, None if declined."""
        shown = self.image(height) if image is None else image
        estimate = self.results.call("pipeline", self.pipeline.process, contact_map(height), shown, after_s)
        return None if estimate is None else self.results.check_rotation(label, estimate, truth_deg)

    def check_distorted_images(self) -> None:
        """Distort the image of an object at rest while the map stays: no confident rotation may be estimated."""
        height = self.heights(lettered, 0.0)
        distort = list(DISTORTIONS.values())[int(self.rng.integers(len(DISTORTIONS)))]
        strength = float(self.rng.uniform(0.0, 1.0))
        for k in range(TEXTURE_FRAMES):
            image = self.image(height)
            if k >= 2:
                last = k == TEXTURE_FRAMES - 1
                image = unrelated_image(self.rng) if last else distort(image, strength, self.rng)
            self.check("pipeline, distorted", height, 0.0, image)

    def check_unseen_rotation(self, surface: Surface) -> None:
        """Rotate the object during a gap by up to what a fall allows: estimated correctly, or declined.

        A periodic one that falls faster than specified may reach the next period, and is not judged.
        """
        gap_s, fall_deg_s2 = float(self.rng.choice(UNSEEN_S)), float(self.rng.choice(FALLS_DEG_S2))
        largest_deg = min(0.5 * fall_deg_s2 * gap_s**2, UNSEEN_MAX_DEG)
        rotation_deg = float(self.rng.uniform(-1.0, 1.0)) * largest_deg
        judged = surface not in PERIODIC or abs(rotation_deg) <= 0.5 * FALL_SPECIFIED_DEG_S2 * gap_s**2
        for k in range(TEXTURE_FRAMES):
            truth_deg = 0.0 if k < 2 else rotation_deg
            height, after_s = self.heights(surface, truth_deg), gap_s if k == 2 else FRAME_S
            if judged:
                self.check(f"{surface.__name__}, unseen", height, truth_deg, after_s=after_s)
            else:
                self.error(height, truth_deg, after_s)

    def error(self, height: Heights, truth_deg: float, after_s: float = FRAME_S) -> float | None:
        """Process the next frame without judging its estimate; return its error, None if declined."""
        image = self.image(height)
        estimate = self.results.call("pipeline", self.pipeline.process, contact_map(height), image, after_s)
        found_deg = None if estimate is None else estimate.rotation_deg
        return None if found_deg is None else abs(found_deg - truth_deg)

    def check_fall(self, fall_deg_s2: float) -> None:
        """Let a toothed object rotate with constant acceleration, from any moment between two frames, in full view."""
        surface, direction = toothed(int(self.rng.choice(TEETH))), float(self.rng.choice((-1.0, 1.0)))
        begin = float(self.rng.uniform(0.0, 1.0))
        for k in range(-2, FALL_FRAMES):
            truth_deg = direction * 0.5 * fall_deg_s2 * (max(k + begin, 0.0) * FRAME_S) ** 2
            if abs(truth_deg) > UNSEEN_MAX_DEG:
                break
            height = self.heights(surface, truth_deg)
            if fall_deg_s2 <= FALL_SPECIFIED_DEG_S2:
                error = self.check(f"falling at {fall_deg_s2:.0f} deg/s2", height, truth_deg)
            else:
                error = self.error(height, truth_deg)
            self.results.add_curve_point("relief fall/pipeline", fall_deg_s2, error)

    def check_rotating(self, surface: Surface, *, visible: bool) -> float | None:
        """Rotate, shift and press the object harder; return the last error, None if declined."""
        direction = float(self.rng.choice((-1.0, 1.0)))
        steps = int(self.rng.integers(2, 9))
        shift_x, shift_y = self.rng.uniform(-14, 14, 2)
        last_force = float(self.rng.uniform(0.85, 1.7))
        error: float | None = None
        for k in range(steps + 1):
            part, rotation_deg = k / steps, direction * STEP_DEG * k
            shift_px = (part * shift_x, part * shift_y)
            height = self.heights(surface, rotation_deg, shift_px, 1.0 + part * (last_force - 1.0))
            error = self.check(surface.__name__, height, rotation_deg if visible else None)
        return error


def _begin_textures(product: ProductFunctions) -> TrialFunction:
    background = np.full((320, 240, 3), round(LEVEL), np.uint8)

    def trial(rng: np.random.Generator, seed: int, results: FamilyResults) -> None:
        seed, kind = divmod(seed, 6)
        lights, noise = _random_lights(rng), TEXTURE_NOISE_LEVELS[seed % len(TEXTURE_NOISE_LEVELS)]
        at = (float(rng.uniform(90, 150)), float(rng.uniform(110, 210)))
        start_deg = float(rng.uniform(-180, 180))
        pipeline = ScriptedPipeline(product, background=background)
        contact = _TexturedContact(pipeline, lights, noise, at, start_deg, rng, results)
        if kind == 5:
            contact.check_fall(FALLS_DEG_S2[seed % len(FALLS_DEG_S2)])
        elif kind == 4:
            contact.check_unseen_rotation(UNSEEN[seed % len(UNSEEN)])
        elif kind == 3:
            contact.check_distorted_images()
        elif kind == 2:
            contact.check_rotating(WITHOUT_TEXTURE[seed % len(WITHOUT_TEXTURE)], visible=False)
        else:
            error = contact.check_rotating(WITH_TEXTURE[seed % len(WITH_TEXTURE)], visible=True)
            results.add_curve_point("relief noise/pipeline", noise, error)

    return trial


def _random_lights(rng: np.random.Generator) -> LedLights:
    """Return lights as they differ between sensor units, some in reverse order."""
    azimuths = np.array([270.0, 150.0, 30.0]) + rng.normal(0.0, 8.0, 3)
    if rng.random() < 0.25:
        azimuths = 180.0 - azimuths
    b, g, r = rng.uniform(0.6, 1.4, 3)
    right, up = rng.uniform(-0.3, 0.3, 2)
    return LedLights((b, g, r), (float(azimuths[0]), float(azimuths[1]), float(azimuths[2])), (right, up))


IMAGES = TrialFamily(
    "pictures", "extreme light, hot pixels, saturated frames, swapped colors, unrelated images", 10_000, 85.0,
    _begin_images, min_answered_share=0.3,
)  # fmt: skip
TEXTURES = TrialFamily(
    "relief", "textured surfaces rotated, shifted, distorted, pressed harder, falling, rotated while unseen", 7_200,
    100.0, _begin_textures, min_answered_share=0.45,
)  # fmt: skip
