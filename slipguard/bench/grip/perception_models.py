"""Two models of a finger: the truth plus the pipeline's errors, and rendered frames through the pipeline."""

from __future__ import annotations

import csv
import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from slipguard.devices import Frame
from slipguard.perception.estimate import Estimate
from slipguard.perception.pipeline import Pipeline
from slipguard.perception.rotation_filter import Hypothesis, RotationFilter
from slipguard.perception.segmenter import Segmenter
from slipguard.perception.settings import PerceptionSettings
from slipguard.sim.gel_camera import GelCamera
from slipguard.sim.gel_view import GelView
from slipguard.sim.scenario import FrameDelivery
from slipguard.sim.sensor_unit import LightChange, random_unit

REFERENCE_FRAMES = 5
"""Frames of a stable contact until the reference is taken."""
WANDER_S = 0.3
"""Correlation time of the slow part of the errors."""
NOMINAL_FPS = 60.0
SLOPE_MAX = 0.9
"""No relative error of a shift is larger."""


@dataclass(frozen=True, slots=True)
class PerceptionErrors:
    """Errors of the pipeline on one object, standard deviations. Biases are drawn once per grasp and finger.

    Attributes:
        noise_deg: Noise of a frame.
        bias_per_deg: Relative error of the rotation.
        bias_deg: Offset that appears with the first degree of motion.
        sigma_deg: Sigma of the estimates.
        declined: Share of declined frames; declined_s: mean duration of a drop-out.
        wander_deg: Slow error, correlated over `WANDER_S`.
        growth_deg: Rotation that a firmer grip seems to cause, by relative growth of the indentation.
        shift_noise_mm, shift_wander_mm: Of the shift, each axis.
        shift_per_deg_mm: Shift that a rotation seems to cause.
        shift_growth_mm: Shift that a firmer grip seems to cause.
        shift_per_mm: Relative error of the shift: a long contact leaves the image.
    """

    noise_deg: float = 0.03
    bias_per_deg: float = 0.01
    bias_deg: float = 0.05
    sigma_deg: float = 0.06
    declined: float = 0.0
    declined_s: float = 0.1
    wander_deg: float = 0.0
    growth_deg: float = 0.0
    shift_noise_mm: float = 0.01
    shift_wander_mm: float = 0.0
    shift_per_deg_mm: float = 0.0
    shift_growth_mm: float = 0.0
    shift_per_mm: float = 0.0


@dataclass(frozen=True, slots=True)
class RotationDrift:
    """Error by a slow change of the light: a sine of amplitude `deg` with this period and phase."""

    deg: float = 0.0
    period_s: float = 30.0
    phase: float = 0.0

    def at(self, now_s: float) -> float:
        """Return the error in degrees at a time."""
        return self.deg * math.sin(2.0 * math.pi * (now_s / self.period_s) + self.phase)


@dataclass(frozen=True, slots=True)
class RotationOutliers:
    """Error of `deg` in single frames: the first frame captured at or after each of these times, in order."""

    times_s: Sequence[float] = ()
    deg: float = 0.0


class ModeledFinger:
    """One finger in one lift: the truth plus errors that were fitted to estimates of rendered grasps."""

    def __init__(self, error: PerceptionErrors, rng: np.random.Generator, drift: RotationDrift | None = None) -> None:
        self._error, self._rng, self._drift = error, rng, drift or RotationDrift()
        self._off: deque[tuple[float, float]] = deque()
        self._bias_per_deg = float(rng.normal(0.0, error.bias_per_deg))
        self._bias_deg = float(rng.normal(0.0, error.bias_deg))
        self._growth_deg = float(rng.normal(0.0, error.growth_deg))
        self._shift_per_deg_mm = rng.normal(0.0, error.shift_per_deg_mm, 2)
        self._shift_growth_mm = rng.normal(0.0, error.shift_growth_mm, 2)
        self._shift_per_mm = float(np.clip(rng.normal(0.0, error.shift_per_mm), -SLOPE_MAX, SLOPE_MAX))
        self._wander = rng.normal(0.0, 1.0, 3)
        self._wandered_s: float | None = None
        self._declined_until_s = -math.inf
        self._depths_mm: deque[float] = deque(maxlen=REFERENCE_FRAMES)
        self._rotations = RotationFilter()
        self._reference: GelView | None = None
        self._start_error_deg = 0.0
        self._start_error_mm = np.zeros(2)

    def reset(self) -> None:
        """Take the next stable contact as the reference."""
        self._reference = None
        self._depths_mm.clear()

    def add_outliers(self, outliers: RotationOutliers) -> None:
        """Let single frames be wrong; earlier ones that have not come yet are forgotten."""
        self._off = deque((time_s, outliers.deg) for time_s in outliers.times_s)

    def process(self, view: GelView, captured_at_s: float, sequence: int) -> Estimate:
        contact = view.depth_mm > 0.0 and view.object_name != ""
        plain = Estimate(sequence, captured_at_s, captured_at_s, contact, 4000 if contact else 0, "model")
        if not contact:
            self._depths_mm.clear()
            return plain
        self._depths_mm.append(view.depth_mm)
        error_deg, error_mm = self._errors(captured_at_s)
        if self._reference is None:
            if len(self._depths_mm) < REFERENCE_FRAMES:
                return plain
            self._reference, self._start_error_deg, self._start_error_mm = view, error_deg, error_mm
            self._rotations.start(captured_at_s)
        start, moved = self._reference, self._moved(view)
        true_deg = view.angle_deg - start.angle_deg
        shift = (1.0 + self._shift_per_mm) * np.array([view.x_mm - start.x_mm, view.y_mm - start.y_mm])
        shift += error_mm - self._start_error_mm + self._shift_per_deg_mm * true_deg + self._shift_growth_mm * moved
        estimate = replace(plain, shift_mm=(float(shift[0]), float(shift[1])))
        if self._declines(captured_at_s):
            return replace(estimate, declined="too uncertain")
        rotation_deg = true_deg + error_deg - self._start_error_deg
        rotation_deg += self._bias_per_deg * true_deg + self._bias_deg * math.tanh(true_deg) + self._growth_deg * moved
        rotation = self._rotations.update(captured_at_s, [Hypothesis(rotation_deg, 0.0)])
        known = rotation.rotation_deg is not None
        return replace(
            estimate,
            rotation_deg=rotation.rotation_deg,
            sigma_deg=self._error.sigma_deg if known else None,
            orientation_deg=0.0 if known else None,
            rate_deg_s=self._rotations.rate_deg_s(captured_at_s) if known else None,
            declined=rotation.declined,
        )

    def _moved(self, view: GelView) -> float:
        """Return the relative growth of the indentation since the reference."""
        assert self._reference is not None
        return view.depth_mm / self._reference.depth_mm - 1.0

    def _errors(self, captured_at_s: float) -> tuple[float, NDArray[np.float64]]:
        """Return noise and wander of rotation and shift in one frame."""
        error, rng = self._error, self._rng
        if self._wandered_s is not None:
            keeps = math.exp(-max(captured_at_s - self._wandered_s, 0.0) / WANDER_S)
            self._wander = keeps * self._wander + math.sqrt(1.0 - keeps * keeps) * rng.normal(0.0, 1.0, 3)
        self._wandered_s = captured_at_s
        noise_deg = float(rng.normal(0.0, error.noise_deg)) + error.wander_deg * float(self._wander[0])
        noise_deg += self._drift.at(captured_at_s)
        if self._off and captured_at_s >= self._off[0][0]:
            noise_deg += self._off.popleft()[1]
        return noise_deg, rng.normal(0.0, error.shift_noise_mm, 2) + error.shift_wander_mm * self._wander[1:]

    def _declines(self, captured_at_s: float) -> bool:
        error = self._error
        if captured_at_s < self._declined_until_s:
            return True
        frames = max(error.declined_s * NOMINAL_FPS, 1.0)
        share = error.declined if error.declined >= 1.0 else error.declined / frames
        if self._rng.random() >= share:
            return False
        self._declined_until_s = captured_at_s + float(self._rng.exponential(error.declined_s))
        return True


def errors_from_csv(text: str) -> dict[str, PerceptionErrors]:
    """Return the errors by object, from a row for each object with a column for each field."""
    rows = list(csv.DictReader(text.splitlines()))
    return {row.pop("object"): PerceptionErrors(**{name: float(value) for name, value in row.items()}) for row in rows}


PERCEPTION_ERRORS = errors_from_csv((Path(__file__).parent / "perception_errors.csv").read_text(encoding="utf-8"))
"""By test object, as measured with `python -m tests.campaigns fit-perception-errors`."""


LIGHT_LEVELS_S = 0.3
"""Drift of the light in gray levels per second."""


class RenderedFinger:
    """One finger in one trial: renders each frame and runs the shipped pipeline on it. unit_seed: sensor unit."""

    def __init__(self, unit_seed: int, delivery: FrameDelivery) -> None:
        unit = random_unit(np.random.default_rng(unit_seed))
        self._camera = GelCamera(unit, seed=delivery.noise_seed)
        self._delivery = delivery
        self._began_s: float | None = None
        self._pipeline = Pipeline(
            segmenter(), PerceptionSettings(), self._camera.no_contact(), unit.noise_bgr, unit.px_per_mm
        )

    def reset(self) -> None:
        """Take the next stable contact as the reference."""
        self._pipeline.reset_reference()

    def process(self, view: GelView, captured_at_s: float, sequence: int) -> Estimate:
        if self._began_s is None:
            self._began_s = captured_at_s
        levels = LIGHT_LEVELS_S * (captured_at_s - self._began_s)
        b, g, r = self._delivery.light_drift_bgr
        self._camera.set_light(LightChange(offset_bgr=(b + levels, g + levels, r + levels)))
        return self._pipeline.process(Frame(self._camera.draw(view), captured_at_s, sequence))


@lru_cache(maxsize=1)
def segmenter() -> Segmenter:
    """Return the shipped network, loaded once per process."""
    return Segmenter()
