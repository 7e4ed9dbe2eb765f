"""A finger that looks with the shipped network at rendered frames."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from slipguard.devices import Frame
from slipguard.perception.contact.segmenter import Segmenter
from slipguard.perception.estimate import Estimate
from slipguard.perception.pipeline import Pipeline
from slipguard.perception.settings import PerceptionSettings
from slipguard.sim.gel_camera import GelCamera
from slipguard.sim.gel_view import GelView
from slipguard.sim.scenario import FrameDelivery
from slipguard.sim.sensor_unit import LightChange, random_unit

LIGHT_LEVELS_S = 0.3
"""The light drifts by so many grey levels a second."""


class RenderedSight:
    """One finger of one trial: draws what it would see and puts it through the real pipeline.

    unit_seed: which sensor unit. The drawing takes place at the moment of exposure, the answer is the pipeline's own.
    """

    def __init__(self, unit_seed: int, delivery: FrameDelivery) -> None:
        unit = random_unit(np.random.default_rng(unit_seed))
        self._camera = GelCamera(unit, seed=delivery.noise_seed)
        self._delivery = delivery
        self._began_s: float | None = None
        self._pipeline = Pipeline(
            segmenter(), PerceptionSettings(), self._camera.no_contact(), unit.noise_bgr, unit.px_per_mm
        )

    def reset(self) -> None:
        """The next stable contact is the new reference."""
        self._pipeline.reset_reference()

    def look(self, view: GelView, captured_at_s: float, sequence: int) -> Estimate:
        """What the pipeline says of the frame exposed now."""
        if self._began_s is None:
            self._began_s = captured_at_s
        levels = LIGHT_LEVELS_S * (captured_at_s - self._began_s)
        b, g, r = self._delivery.light_drift_bgr
        self._camera.set_light(LightChange(offset_bgr=(b + levels, g + levels, r + levels)))
        return self._pipeline.process(Frame(self._camera.draw(view), captured_at_s, sequence))


@lru_cache(maxsize=1)
def segmenter() -> Segmenter:
    """The shipped network, read once a process."""
    return Segmenter()
