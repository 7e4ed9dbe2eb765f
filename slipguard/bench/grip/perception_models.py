"""Two models of a finger: the truth plus errors of the pipeline's size, and rendered frames through the pipeline."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

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
SLOPE_MAX = 0.9
"""No relative error of a shift is larger."""


@dataclass(frozen=True, slots=True)
class PerceptionErrors:
    """Errors of the pipeline, standard deviations. Those after the first three are drawn once per grasp and finger.

    The defaults are those of the median of eight test objects in 24 rendered grasps, or a little wider.

    Attributes:
        noise_deg, shift_noise_mm: Noise of a frame; of the shift, each axis.
        sigma_deg: Sigma of the estimates.
        bias_per_deg: Relative error of the rotation.
        growth_deg: Rotation that a firmer grip seems to cause, by relative growth of the indentation.
        shift_growth_mm: Shift that a firmer grip seems to cause.
        shift_per_mm: Relative error of the shift: a long contact leaves the image.
        declined: No estimate is given.
    """

    noise_deg: float = 0.02
    shift_noise_mm: float = 0.0015
    sigma_deg: float = 0.2
    bias_per_deg: float = 0.004
    growth_deg: float = 0.4
    shift_growth_mm: float = 0.15
    shift_per_mm: float = 0.05
    declined: bool = False


class ModeledFinger:
    """One finger in one lift: the truth plus errors.

    Attributes:
    """

    def __init__(self, error: PerceptionErrors, rng: np.random.Generator) -> None:
        self._error, self._rng = error, rng
        self._bias_per_deg = float(rng.normal(0.0, error.bias_per_deg))
        self._growth_deg = float(rng.normal(0.0, error.growth_deg))
        self._shift_growth_mm = rng.normal(0.0, error.shift_growth_mm, 2)
        self._shift_per_mm = float(np.clip(rng.normal(0.0, error.shift_per_mm), -SLOPE_MAX, SLOPE_MAX))
        self._depths_mm: deque[float] = deque(maxlen=REFERENCE_FRAMES)
        self._rotations = RotationFilter()
        self._reference: GelView | None = None
        self._start_error_deg = 0.0
        self._start_error_mm = np.zeros(2)
        self.wrong_s: deque[float] = deque()
        self.wrong_deg = 0.0

    def reset(self) -> None:
        """Take the next stable contact as the reference."""
        self._reference = None
        self._depths_mm.clear()

    def add_outliers(self, times_s: Sequence[float], deg: float) -> None:
        """Let the rotation be wrong by `deg` in the first frame at or after each of these times, in order."""
        self.wrong_s, self.wrong_deg = deque(times_s), deg

    def process(self, view: GelView, captured_at_s: float, sequence: int) -> Estimate:
        contact = view.depth_mm > 0.0 and view.object_name != ""
        plain = Estimate(sequence, captured_at_s, captured_at_s, contact, 4000 if contact else 0, "model")
        if not contact:
            self._depths_mm.clear()
            return plain
        self._depths_mm.append(view.depth_mm)
        error_deg, error_mm = self._noise(captured_at_s)
        if self._reference is None:
            if len(self._depths_mm) < REFERENCE_FRAMES:
                return plain
            self._reference, self._start_error_deg, self._start_error_mm = view, error_deg, error_mm
            self._rotations.start(captured_at_s)
        start = self._reference
        growth = view.depth_mm / start.depth_mm - 1.0
        true_deg = view.angle_deg - start.angle_deg
        shift = (1.0 + self._shift_per_mm) * np.array([view.x_mm - start.x_mm, view.y_mm - start.y_mm])
        shift += error_mm - self._start_error_mm + self._shift_growth_mm * growth
        estimate = replace(plain, shift_mm=(float(shift[0]), float(shift[1])))
        if self._error.declined:
            return replace(estimate, declined="too uncertain")
        rotation_deg = (1.0 + self._bias_per_deg) * true_deg + self._growth_deg * growth
        rotation_deg += error_deg - self._start_error_deg
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

    def _noise(self, captured_at_s: float) -> tuple[float, NDArray[np.float64]]:
        """Return the error of rotation and shift in one frame."""
        deg = float(self._rng.normal(0.0, self._error.noise_deg))
        if self.wrong_s and captured_at_s >= self.wrong_s[0]:
            self.wrong_s.popleft()
            deg += self.wrong_deg
        return deg, self._rng.normal(0.0, self._error.shift_noise_mm, 2)


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
