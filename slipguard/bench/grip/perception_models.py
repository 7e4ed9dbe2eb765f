"""Two models of a finger: the truth plus the pipeline's errors, and rendered frames through the pipeline."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from slipguard.devices import Frame
from slipguard.perception.contact.segmenter import Segmenter
from slipguard.perception.estimate import Estimate
from slipguard.perception.pipeline import Pipeline
from slipguard.perception.rotation.fusion import RotationEstimate
from slipguard.perception.rotation.rotation_tracker import RotationTracker
from slipguard.perception.settings import PerceptionSettings
from slipguard.sim.gel_camera import GelCamera
from slipguard.sim.gel_view import GelView
from slipguard.sim.scenario import FrameDelivery
from slipguard.sim.sensor_unit import LightChange, random_unit

REFERENCE_FRAMES = 5
"""Frames of a stable contact until the reference is taken."""
SHIFT_NOISE_MM = 0.01


@dataclass(frozen=True, slots=True)
class PerceptionErrors:
    """Errors of the pipeline on one object.

    Attributes:
        noise_deg: Standard deviation of the noise of a frame.
        bias_per_deg: Standard deviation of the relative error, drawn once per grasp.
        bias_deg: Standard deviation of an offset that appears with the first degree of motion, drawn once per grasp.
        sigma_deg: Sigma of the estimates.
        declined: Share of declined frames.
    """

    noise_deg: float = 0.03
    bias_per_deg: float = 0.01
    bias_deg: float = 0.05
    sigma_deg: float = 0.06
    declined: float = 0.0


@dataclass(frozen=True, slots=True)
class RotationDrift:
    """Error by a slow change of the light: a sine of amplitude `deg` with this period and phase."""

    deg: float = 0.0
    period_s: float = 30.0
    phase: float = 0.0

    def at(self, now_s: float) -> float:
        return self.deg * math.sin(2.0 * math.pi * (now_s / self.period_s) + self.phase)


@dataclass(frozen=True, slots=True)
class RotationOutliers:
    """Error of `deg` in single frames: the first frame captured at or after each of these times, in order."""

    times_s: Sequence[float] = ()
    deg: float = 0.0


class ModeledFinger:
    """One finger in one trial: the truth plus errors that were fitted to estimates of rendered grasps."""

    def __init__(self, error: PerceptionErrors, rng: np.random.Generator, drift: RotationDrift | None = None) -> None:
        self._error, self._rng, self._drift = error, rng, drift or RotationDrift()
        self._off: deque[tuple[float, float]] = deque()
        self._bias_per_deg = float(rng.normal(0.0, error.bias_per_deg))
        self._bias_deg = float(rng.normal(0.0, error.bias_deg))
        self._areas: deque[float] = deque(maxlen=REFERENCE_FRAMES)
        self._tracker = RotationTracker()
        self._reference: tuple[float, float, float] | None = None

    def reset(self) -> None:
        """Take the next stable contact as the reference."""
        self._reference = None
        self._areas.clear()

    def add_outliers(self, outliers: RotationOutliers) -> None:
        self._off = deque((time_s, outliers.deg) for time_s in outliers.times_s)

    def process(self, view: GelView, captured_at_s: float, sequence: int) -> Estimate:
        contact = view.depth_mm > 0.0 and view.object_name != ""
        plain = Estimate(sequence, captured_at_s, captured_at_s, contact, 4000 if contact else 0, "model")
        if not contact:
            self._areas.clear()
            return plain
        self._areas.append(view.depth_mm)
        noisy_deg = view.angle_deg + float(self._rng.normal(0.0, self._error.noise_deg)) + self._drift.at(captured_at_s)
        if self._off and captured_at_s >= self._off[0][0]:
            noisy_deg += self._off.popleft()[1]
        if self._reference is None:
            if len(self._areas) < REFERENCE_FRAMES:
                return plain
            self._reference = (view.angle_deg, noisy_deg - view.angle_deg, view.y_mm)
            self._tracker.start(captured_at_s)
        start_deg, start_error_deg, start_y_mm = self._reference
        true_deg = view.angle_deg - start_deg
        shift_mm = (0.0, view.y_mm - start_y_mm + float(self._rng.normal(0.0, SHIFT_NOISE_MM)))
        if self._rng.random() < self._error.declined:
            return Estimate(
                sequence, captured_at_s, captured_at_s, True, 4000, "model", shift_mm=shift_mm, declined="too uncertain"
            )
        moved = math.tanh(true_deg)
        rotation_deg = noisy_deg - start_deg - start_error_deg + self._bias_per_deg * true_deg + self._bias_deg * moved
        rotation = self._tracker.accept(captured_at_s, RotationEstimate(rotation_deg, self._error.sigma_deg))
        return Estimate(
            sequence,
            captured_at_s,
            captured_at_s,
            True,
            4000,
            "model",
            rotation_deg=rotation.rotation_deg,
            sigma_deg=rotation.sigma_deg,
            orientation_deg=None if rotation.rotation_deg is None else 0.0,
            rate_deg_s=None if rotation.rotation_deg is None else self._tracker.rate_deg_s(captured_at_s),
            shift_mm=shift_mm,
            declined=rotation.declined,
        )


PERCEPTION_ERRORS: dict[str, PerceptionErrors] = {
    "bar": PerceptionErrors(0.020, 0.0042, 0.029, 0.056, 0.0000),
    "wedge": PerceptionErrors(0.118, 0.0135, 0.210, 0.231, 0.0000),
    "wrench": PerceptionErrors(0.015, 0.0007, 0.026, 0.038, 0.0000),
    "knife_edge": PerceptionErrors(0.046, 0.0199, 0.326, 0.192, 0.0000),
    "key": PerceptionErrors(0.013, 0.0013, 0.022, 0.046, 0.0000),
    "screwdriver": PerceptionErrors(0.032, 0.0057, 0.045, 0.436, 0.0000),
    "cap": PerceptionErrors(0.016, 0.0009, 0.010, 0.039, 0.0000),
    "ball": PerceptionErrors(0.067, 0.0185, 0.145, 0.253, 0.0000),
    "hook": PerceptionErrors(0.088, 0.0447, 0.320, 0.300, 0.0000),
}
"""noise_deg, bias_per_deg, bias_deg, sigma_deg, declined."""


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
