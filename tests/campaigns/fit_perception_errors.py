"""A fit of the error model of `slipguard bench --grip` to the errors of the shipped pipeline, object by object.

Each rendered grasp rests, twists a little, rotates, is gripped firmer and slides, with a rest after each. The
difference between the rests is the bias that the motion leaves; what changes within a rest is noise and wander.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import astuple, dataclass, fields
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from slipguard.bench.grip.perception_models import PerceptionErrors, segmenter
from slipguard.bench.grip.scenarios import TEST_OBJECTS
from slipguard.devices import Frame
from slipguard.perception.pipeline import Pipeline
from slipguard.perception.settings import PerceptionSettings
from slipguard.sim.catalogue import find_object
from slipguard.sim.gel_camera import GelCamera
from slipguard.sim.gel_view import GelView
from slipguard.sim.sensor_unit import LightChange, random_unit

FRAME_S = 1.0 / 60.0
CLOSING = 6
REST, TWIST, ROTATE, GRIP, SLIDE = 40, 15, 30, 12, 24
TWIST_DEG, ROTATE_DEG, GROWTH, SLIDE_MM = 2.0, 15.0, 1.3, 4.0
POSITION_MM = 2.0
WANDER_FRAMES = 10
"""Means of this many frames show the slow part of the error."""
MEDIAN_OF_A_DIFFERENCE = 0.954
"""Median absolute difference of two normal values, in standard deviations."""


@dataclass(frozen=True, slots=True)
class MeasuredFrame:
    """One frame: the part of the grasp, and the errors, None without an estimate. shift_mm: right and up."""

    part: str
    rotation_deg: float | None
    sigma_deg: float | None
    shift_mm: tuple[float, float] | None


def measure(object_name: str, seed: int) -> list[MeasuredFrame]:
    """Return the errors of every frame of one rendered grasp after its reference."""
    rng = np.random.default_rng([seed, *object_name.encode()])
    unit = random_unit(rng)
    camera = GelCamera(unit, seed=seed)
    pipeline = Pipeline(segmenter(), PerceptionSettings(), camera.no_contact(), unit.noise_bgr, unit.px_per_mm)
    camera.set_light(LightChange(1.0, tuple(rng.uniform(-5.0, 5.0, 3))))
    start, frames = None, []
    for index, (part, view) in enumerate(_views(object_name, rng)):
        estimate = pipeline.process(Frame(camera.draw(view), index * FRAME_S, index))
        if part == "closing" or (start is None and estimate.shift_mm is None):
            continue
        start = start or view
        rotation_deg, shift_mm = estimate.rotation_deg, estimate.shift_mm
        moved_mm = view.center_shift_mm(start)
        frames.append(
            MeasuredFrame(
                part,
                None if rotation_deg is None else rotation_deg - (view.angle_deg - start.angle_deg),
                estimate.sigma_deg,
                None if shift_mm is None else (shift_mm[0] - moved_mm[0], shift_mm[1] - moved_mm[1]),
            )
        )
    return frames


def _views(object_name: str, rng: np.random.Generator) -> Iterator[tuple[str, GelView]]:
    press_mm = find_object(object_name).press_mm * float(rng.uniform(0.6, 0.85))
    x_mm, y_mm = (float(v) for v in rng.uniform(-POSITION_MM, POSITION_MM, 2))
    angle_deg, side = float(rng.uniform(-90.0, 90.0)), float(rng.choice((-1.0, 1.0)))
    toward = float(rng.uniform(-math.pi, math.pi))
    for k in range(CLOSING):
        yield "closing", GelView(object_name, x_mm, y_mm, angle_deg, press_mm * (k + 1) / CLOSING)
    steps = (
        ("rest", 0, 0.0, 1.0, 0.0),
        ("twisted", TWIST, side * TWIST_DEG, 1.0, 0.0),
        ("rotated", ROTATE, side * ROTATE_DEG, 1.0, 0.0),
        ("gripped", GRIP, side * ROTATE_DEG, GROWTH, 0.0),
        ("slid", SLIDE, side * ROTATE_DEG, GROWTH, SLIDE_MM),
    )
    before = (0.0, 1.0, 0.0)
    for part, moving, *goal in steps:
        for k in range(moving + REST):
            done = min((k + 1) / moving, 1.0) if moving else 1.0
            deg, growth, mm = (old + done * (new - old) for old, new in zip(before, goal, strict=True))
            x, y = x_mm + mm * math.cos(toward), y_mm + mm * math.sin(toward)
            name = part if k >= moving else f"to {part}"
            yield name, GelView(object_name, x, y, angle_deg + deg, press_mm * growth)
        before = (goal[0], goal[1], goal[2])


def fit_errors(object_name: str, grasps: int) -> PerceptionErrors:
    """Return the error model of one object, fitted to rendered grasps."""
    found: dict[str, list[float]] = {}
    runs_s: list[float] = []
    declined = count = 0

    def add(name: str, value: float | np.floating) -> None:
        if math.isfinite(value):
            found.setdefault(name, []).append(float(value))

    for seed in range(grasps):
        frames = measure(object_name, seed)
        lost = [frame.rotation_deg is None for frame in frames]
        declined, count = declined + sum(lost), count + len(lost)
        runs_s += [FRAME_S * len(list(run)) for none, run in groupby(lost) if none]
        rest = {
            part: (_rotations(frames, part), _shifts(frames, part))
            for part in ("rest", "twisted", "rotated", "gripped", "slid")
        }
        add(
            "sigma",
            np.median([f.sigma_deg for f in frames if f.part == "twisted" and f.sigma_deg is not None] or [math.nan]),
        )
        for rotations, shifts in rest.values():
            add("noise", _noise(rotations))
            add("wander", _wander(rotations))
            for axis in shifts.T:
                add("shift noise", _noise(axis))
                add("shift wander", _wander(axis))
        mean = {
            part: (_mean(rotations), np.array([_mean(axis) for axis in shifts.T]))
            for part, (rotations, shifts) in rest.items()
        }
        add("offset", mean["twisted"][0] - mean["rest"][0])
        add("slope", (mean["rotated"][0] - mean["rest"][0]) / ROTATE_DEG)
        add("growth", (mean["gripped"][0] - mean["rotated"][0]) / (GROWTH - 1.0))
        for axis in range(2):
            moved = {part: mean[part][1][axis] for part in mean}
            add("shift per deg", (moved["rotated"] - moved["rest"]) / ROTATE_DEG)
            add("shift growth", (moved["gripped"] - moved["rotated"]) / (GROWTH - 1.0))
            add("shift slope", (moved["slid"] - moved["gripped"]) / SLIDE_MM)
    rms = {name: float(np.sqrt(np.mean(np.square(values)))) for name, values in found.items()}
    return PerceptionErrors(
        noise_deg=rms.get("noise", 0.0),
        bias_per_deg=rms.get("slope", 0.0),
        bias_deg=rms.get("offset", 0.0),
        sigma_deg=float(np.median(found["sigma"])) if "sigma" in found else PerceptionErrors().sigma_deg,
        declined=declined / max(count, 1),
        declined_s=float(np.mean(runs_s)) if runs_s else PerceptionErrors().declined_s,
        wander_deg=rms.get("wander", 0.0),
        growth_deg=rms.get("growth", 0.0),
        shift_noise_mm=rms.get("shift noise", 0.0),
        shift_wander_mm=rms.get("shift wander", 0.0),
        shift_per_deg_mm=rms.get("shift per deg", 0.0),
        shift_growth_mm=rms.get("shift growth", 0.0),
        shift_per_mm=rms.get("shift slope", 0.0),
    )


def _rotations(frames: list[MeasuredFrame], part: str) -> NDArray[np.float64]:
    return np.array([frame.rotation_deg for frame in frames if frame.part == part and frame.rotation_deg is not None])


def _shifts(frames: list[MeasuredFrame], part: str) -> NDArray[np.float64]:
    return np.array([f.shift_mm for f in frames if f.part == part and f.shift_mm is not None]).reshape(-1, 2)


def _mean(values: NDArray[np.float64]) -> float:
    return float(values.mean()) if len(values) else math.nan


def _noise(values: NDArray[np.float64]) -> float:
    return float(np.median(np.abs(np.diff(values)))) / MEDIAN_OF_A_DIFFERENCE if len(values) > 2 else math.nan


def _wander(values: NDArray[np.float64]) -> float:
    """Return the standard deviation of the error's slow part within a rest."""
    whole = len(values) // WANDER_FRAMES
    if whole < 2:
        return math.nan
    return float(values[: whole * WANDER_FRAMES].reshape(whole, WANDER_FRAMES).mean(axis=1).std())


def error_table(grasps: int) -> str:
    """Return the error model of every test object, as CSV."""
    rows = [("object", *(field.name for field in fields(PerceptionErrors)))]
    rows += [(name, *(f"{value:.4g}" for value in astuple(fit_errors(name, grasps)))) for name in TEST_OBJECTS]
    return "\n".join(",".join(row) for row in rows)
