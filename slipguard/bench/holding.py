"""A minute of holding, rendered, and what it costs each pipeline."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from slipguard.bench.pipelines import BenchPipeline
from slipguard.datasets.rendered_grasps import FRAME_S, GraspFrame, RenderedGrasp
from slipguard.devices import Frame
from slipguard.sim.catalogue import find_object
from slipguard.sim.gel_camera import GelCamera
from slipguard.sim.gel_view import GelView
from slipguard.sim.sensor_unit import LightChange, random_unit

MINUTE_S = 60.0
EMPTY_S, CLOSED_S, AT_REST_S = 0.4, 0.5, 1.5
LIFTED_S = 4.0
"""Until this time the arm's motion shakes the object by `SHAKE_MM`."""
SHAKE_MM, SHAKE_HZ = 0.02, 7.0
RELEASED_S = 59.5
ROTATIONS = ((1.5, 2.1, 8.0, 0.15), (20.0, 23.0, 1.5, 0.0), (40.0, 40.4, 6.0, 0.10))
"""Start and end (s), rotation (degrees), relative increase of the depth: a slip, a creep, a faster slip."""
DRIFT_LEVELS = 1.5
"""Change of the light over the minute, in gray levels."""


@dataclass(frozen=True, slots=True)
class HoldingScene:
    """A grasp of 60 s at 60 frames/s with slips and creep; `shots` renders the same frames for the same seed.

    press: depth as a share of the object's depth at 40 N. sign: -1 for the opposite finger, which sees rotations with
    the opposite sign.
    """

    object_name: str = "wrench"
    seed: int = 6000
    press: float = 0.6
    sign: float = 1.0

    def sensor(self) -> RenderedGrasp:
        """Return the sensor's data that a pipeline needs, without frames."""
        unit = random_unit(np.random.default_rng(self.seed))
        background = GelCamera(unit, seed=self.seed).no_contact()
        return RenderedGrasp(self.object_name, True, background, unit.noise_bgr, unit.px_per_mm, ())

    def shots(self) -> Iterator[GraspFrame]:
        """Yield all 3600 frames with their truth."""
        rng = np.random.default_rng(self.seed)
        camera = GelCamera(random_unit(rng), seed=self.seed)
        x_mm, y_mm, start_deg = float(rng.uniform(-1, 1)), float(rng.uniform(-1, 1)), float(rng.uniform(-180, 180))
        press_mm = self.press * find_object(self.object_name).press_mm
        offset = rng.uniform(-3.0, 3.0, 3)
        drift = rng.choice([-1.0, 1.0], 3) * DRIFT_LEVELS / MINUTE_S
        for index in range(round(MINUTE_S / FRAME_S)):
            now_s = index * FRAME_S
            if index % 60 == 0:
                b, g, r = offset + drift * now_s
                camera.set_light(LightChange(1.0, (float(b), float(g), float(r))))
            rotation_deg, rate_deg_s, grown = _motion(now_s)
            rotation_deg, rate_deg_s = self.sign * rotation_deg, self.sign * rate_deg_s
            view = GelView(
                self.object_name, x_mm, y_mm, start_deg + rotation_deg, press_mm * grown, rate_deg_s=rate_deg_s
            )
            if AT_REST_S <= now_s < LIFTED_S:
                view = replace(view, y_mm=y_mm + SHAKE_MM * float(np.sin(2.0 * np.pi * SHAKE_HZ * now_s)))
            if now_s < CLOSED_S:
                part = (now_s - EMPTY_S) / (CLOSED_S - EMPTY_S)
                view = replace(view, depth_mm=press_mm * max(part, 0.0))
            if now_s > RELEASED_S:
                view = replace(view, depth_mm=0.0)
            in_contact = view.depth_mm > 0.0
            compared = in_contact and now_s > AT_REST_S
            yield GraspFrame(Frame(camera.draw(view), now_s, index), in_contact, rotation_deg, compared, None)


def _motion(now_s: float) -> tuple[float, float, float]:
    """Return rotation, rate, and depth relative to the initial depth."""
    rotation_deg, rate_deg_s, grown = 0.0, 0.0, 1.0
    for begin_s, end_s, total_deg, growth in ROTATIONS:
        part = min(max((now_s - begin_s) / (end_s - begin_s), 0.0), 1.0)
        rotation_deg += total_deg * part * part * (3.0 - 2.0 * part)
        rate_deg_s += total_deg * 6.0 * part * (1.0 - part) / (end_s - begin_s)
        grown *= 1.0 + growth * part
    return rotation_deg, rate_deg_s, grown


UNSKIPPED_STEP = 10
"""Without skipping all frames take the same time: every tenth frame is measured."""
WARM_UP = 40


@dataclass(slots=True)
class HoldingResult:
    """Times and errors of one pipeline over the minute.

    frames: processed frames. skipped: number of these by the reason for skipping. measured_s: time of the others.
    """

    frames: int = 0
    wall_s: float = 0.0
    cpu_s: float = 0.0
    errors_deg: list[float] = field(default_factory=list)
    skipped: dict[str, int] = field(default_factory=dict)
    measured_s: float = 0.0

    @property
    def measured_ms(self) -> float:
        """Mean time of a frame that was not skipped."""
        return 1e3 * self.measured_s / max(self.frames - sum(self.skipped.values()), 1)

    @property
    def mean_ms(self) -> float:
        return 1e3 * self.wall_s / max(self.frames, 1)

    @property
    def cpu_s_per_minute(self) -> float:
        """Processor time of a minute of frames, in seconds of one core."""
        return 60.0 * 60.0 * self.cpu_s / max(self.frames, 1)


def measure_holding(
    pipelines: list[BenchPipeline], scene: HoldingScene, every: dict[str, int] | None = None
) -> dict[str, HoldingResult]:
    """Return the results of pipelines over the same frames, by name. every: frame steps by name."""
    sensor = scene.sensor()
    opened: list[tuple[BenchPipeline, Any, int]] = [
        (one, one.open(sensor), (every or {}).get(one.name, 1 if one.skips.unchanged else UNSKIPPED_STEP))
        for one in pipelines
    ]
    held = {one.name: HoldingResult() for one in pipelines}
    for index, shot in enumerate(scene.shots()):
        for pipeline, processor, step in opened:
            # The reference needs every frame of the start.
            if step > 1 and index > WARM_UP + 60 and index % step:
                continue
            own = held[pipeline.name]
            cpu_s, wall_s = time.process_time(), time.perf_counter()
            estimate = processor.process(shot.frame)
            wall_s, cpu_s = time.perf_counter() - wall_s, time.process_time() - cpu_s
            if step == 1 or index % step == 0:
                own.frames += 1
                own.wall_s += wall_s
                own.cpu_s += cpu_s
                own.measured_s += wall_s if estimate.skipped is None else 0.0
            if estimate.skipped is not None:
                own.skipped[estimate.skipped] = own.skipped.get(estimate.skipped, 0) + 1
            if shot.compared and estimate.rotation_deg is not None:
                own.errors_deg.append(abs(estimate.rotation_deg - shot.rotation_deg))
    return held
