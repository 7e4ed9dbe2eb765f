"""Scenes of the bench, and what one pipeline does in each: its times, masks and errors."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from typing import Literal

import cv2
import numpy as np

from slipguard.bench.comparison_pipelines import FrameProcessor
from slipguard.bench.pipelines import NO_SKIP, BenchPipeline
from slipguard.datasets.effect_scenes import EFFECTS, EffectName, render_effect
from slipguard.datasets.mask_scores import dice, iou
from slipguard.datasets.rendered_grasps import FRAME_S, STILL_FRAMES, GraspFrame, RenderedGrasp, render_grasp
from slipguard.devices import Frame
from slipguard.perception.estimate import Estimate
from slipguard.perception.skipping import ALL_SKIPS
from slipguard.sim.catalogue import find_object
from slipguard.sim.gel_camera import GelCamera
from slipguard.sim.gel_view import GelView
from slipguard.sim.sensor_unit import LightChange, random_unit
from slipguard.tools.experiment import Case

SceneKind = Literal["grasp", "holding"] | EffectName
WARM_UP_FRAMES = 40
HOLD_S, SETTLED_S = 20.0, 1.5
HELD_ROTATIONS = ((1.5, 2.1, 8.0, 0.15), (6.0, 9.0, 1.5, 0.0), (14.0, 14.4, 6.0, 0.10))
"""Begin and end (s), rotation (degrees), relative increase of the depth: a slip, a creep, a faster slip."""
DRIFT_LEVELS = 1.5
"""Change of the light while an object is held, in gray levels."""
UNSKIPPED_STEP = 10
"""Without skipping all frames of a held object take about the same time: every tenth one is measured."""


@dataclass(frozen=True, slots=True)
class Scene:
    """What a case of the bench renders and for which pipelines.

    Attributes:
        mask_every: Every so-many-th frame of a grasp has a label.
        warm: Whether the pipelines process some frames before they are timed.
        sparse: Frame step of pipelines that see each frame by itself and take long.
    """

    kind: SceneKind
    pipelines: tuple[BenchPipeline, ...]
    mask_every: int = 4
    warm: bool = False
    sparse: int = 1


@dataclass(slots=True)
class SceneOutcome:
    """One pipeline in one scene; picklable.

    Attributes:
        times_ms: Of `process`, by kind of frame: "contact", "no contact" (measured), or the reason for skipping.
        overlaps: (Dice, IoU) of segmented frames with a label; a labeled contact skipped as "no contact" has 0.
        compared: Number of frames compared with the truth.
        errors: (absolute error, rotation, sigma) of those not declined, degrees.
        shifts_mm: Absolute errors of the reported shifts.
    """

    object_name: str
    readable: bool
    difficulty: float
    times_ms: dict[str, list[float]] = field(default_factory=dict)
    stage_ms: dict[str, list[float]] = field(default_factory=dict)
    overlaps: list[tuple[float, float]] = field(default_factory=list)
    compared: int = 0
    errors: list[tuple[float, float, float | None]] = field(default_factory=list)
    shifts_mm: list[float] = field(default_factory=list)

    def take(self, processor: FrameProcessor, shot: GraspFrame) -> None:
        """Process the next frame of the scene."""
        began_s = time.perf_counter()
        estimate = processor.process(shot.frame)
        self._add_time(estimate, 1e3 * (time.perf_counter() - began_s))
        if shot.contact and shot.mask is not None:
            label = shot.mask > 0
            if estimate.skipped is None and estimate.segmented:
                found = processor.last_mask > 0
                self.overlaps.append((dice(found, label), iou(found, label)))
            elif estimate.skipped == "no contact" and label.any():
                self.overlaps.append((0.0, 0.0))
        if not shot.compared:
            return
        self.compared += 1
        if estimate.rotation_deg is not None:
            error_deg = abs(estimate.rotation_deg - shot.rotation_deg)
            self.errors.append((error_deg, estimate.rotation_deg, estimate.sigma_deg))
        if estimate.shift_mm is not None and shot.shift_mm is not None:
            self.shifts_mm.append(float(np.hypot(*np.subtract(estimate.shift_mm, shot.shift_mm))))

    def _add_time(self, estimate: Estimate, spent_ms: float) -> None:
        kind = estimate.skipped or ("contact" if estimate.contact else "none found")
        self.times_ms.setdefault(kind, []).append(spent_ms)
        if kind == "contact":
            for stage, ms in estimate.stage_ms.items():
                self.stage_ms.setdefault(stage, []).append(ms)


def measure(case: Case[Scene]) -> dict[str, SceneOutcome]:
    """Return the outcome of each pipeline in a scene, by its name. The case is named after the object."""
    cv2.setNumThreads(1)
    scene = case.parameters
    if scene.kind == "holding":
        return _measure_held(case)
    if scene.kind in EFFECTS:
        grasp = render_effect(scene.kind, case.name, case.seed)
    else:
        grasp = render_grasp(case.name, case.seed, with_masks=True, mask_every=scene.mask_every)
    found = {}
    for pipeline in scene.pipelines:
        if scene.warm:
            _warm(pipeline, grasp)
        outcome = found[pipeline.name] = _outcome(grasp)
        processor = pipeline.open(grasp)
        for shot in _shots_for(pipeline, grasp, scene):
            outcome.take(processor, shot)
    return found


def _shots_for(pipeline: BenchPipeline, grasp: RenderedGrasp, scene: Scene) -> Iterable[GraspFrame]:
    """Return the frames; a pipeline without memory starts at the last frame at rest, which is its reference."""
    if pipeline.kind in ("ours", "zero"):
        return grasp.shots
    begin = next(index for index, shot in enumerate(grasp.shots) if shot.compared) - 1
    if scene.kind == "grasp" and scene.mask_every <= STILL_FRAMES:
        begin -= begin % scene.mask_every  # a frame at rest that has a label
    return grasp.shots[begin :: scene.sparse if pipeline.kind == "paper" else 1]


def _warm(pipeline: BenchPipeline, grasp: RenderedGrasp) -> None:
    processor = pipeline.open(grasp)
    labeled = [shot for shot in grasp.shots if shot.mask is not None]
    for shot in labeled[:2] if pipeline.sees == "frame" else grasp.shots[:WARM_UP_FRAMES]:
        processor.process(shot.frame)


def _outcome(grasp: RenderedGrasp) -> SceneOutcome:
    """Return an empty outcome. Speed and growth of the contact make a grasp difficult: 0 to 1."""
    fast, grown = min(grasp.peak_deg_s / 300.0, 1.0), min((grasp.growth - 1.0) / 0.8, 1.0)
    return SceneOutcome(grasp.object_name, grasp.readable, 0.5 * (fast + grown))


def _measure_held(case: Case[Scene]) -> dict[str, SceneOutcome]:
    """Process an object that is held: all pipelines in step, because its frames do not fit into memory."""
    unit = random_unit(np.random.default_rng(case.seed))
    background = GelCamera(unit, seed=case.seed).no_contact()
    sensor = RenderedGrasp(case.name, True, background, unit.noise_bgr, unit.px_per_mm, ())
    opened = [(one, one.open(sensor), _outcome(sensor)) for one in case.parameters.pipelines]
    settled = round((SETTLED_S + 1.0) / FRAME_S)  # the reference needs every frame of the start
    for index, shot in enumerate(held_frames(case.name, case.seed)):
        for pipeline, processor, outcome in opened:
            if pipeline.skips != NO_SKIP or index < settled or index % UNSKIPPED_STEP == 0:
                outcome.take(processor, shot)
    return {pipeline.name: outcome for pipeline, _, outcome in opened}


def held_frames(object_name: str, seed: int) -> Iterator[GraspFrame]:
    """Yield frames of an object that is held for `HOLD_S`: it slips, creeps and slips faster while the light drifts."""
    rng = np.random.default_rng(seed)
    camera = GelCamera(random_unit(rng), seed=seed)
    x_mm, y_mm, start_deg = float(rng.uniform(-1, 1)), float(rng.uniform(-1, 1)), float(rng.uniform(-180, 180))
    press_mm = 0.6 * find_object(object_name).press_mm
    offset, drift = rng.uniform(-3.0, 3.0, 3), rng.choice([-1.0, 1.0], 3) * DRIFT_LEVELS / HOLD_S
    for index in range(round(HOLD_S / FRAME_S)):
        now_s = index * FRAME_S
        if index % 60 == 0:
            b, g, r = offset + drift * now_s
            camera.set_light(LightChange(1.0, (float(b), float(g), float(r))))
        rotation_deg, rate_deg_s, grown = _held_motion(now_s)
        closed = min(max(10.0 * (now_s - 0.4), 0.0), 1.0) if now_s < HOLD_S - 0.5 else 0.0
        depth_mm = press_mm * grown * closed
        view = GelView(object_name, x_mm, y_mm, start_deg + rotation_deg, depth_mm, rate_deg_s=rate_deg_s)
        compared = depth_mm > 0.0 and now_s > SETTLED_S
        yield GraspFrame(Frame(camera.draw(view), now_s, index), depth_mm > 0.0, rotation_deg, compared, None)


def _held_motion(now_s: float) -> tuple[float, float, float]:
    """Return rotation, rate, and depth relative to the initial depth."""
    rotation_deg, rate_deg_s, grown = 0.0, 0.0, 1.0
    for begin_s, end_s, total_deg, growth in HELD_ROTATIONS:
        part = min(max((now_s - begin_s) / (end_s - begin_s), 0.0), 1.0)
        rotation_deg += total_deg * part * part * (3.0 - 2.0 * part)
        rate_deg_s += total_deg * 6.0 * part * (1.0 - part) / (end_s - begin_s)
        grown *= 1.0 + growth * part
    return rotation_deg, rate_deg_s, grown


def single_skips(default: BenchPipeline) -> dict[str, BenchPipeline]:
    """Return the default pipeline without each skip, by the name of the skip."""
    names = {
        "no contact: no network": "no_contact",
        "unchanged: the last estimate": "unchanged",
        "moves as a whole: no network": "whole",
    }
    return {text: replace(default, skips=replace(ALL_SKIPS, **{name: False})) for text, name in names.items()}
