"""A finger's perceiver for pictures that carry numbers: what the pipeline would say, without looking."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from slipguard.bench.grip.modeled_perception import ModelSight, SightError
from slipguard.devices import Frame
from slipguard.perception.estimate import Estimate
from slipguard.perception.quality.image_quality import UNLIKE
from slipguard.sim.gel_view import decode_view

BRIGHT_LEVELS = 30.0
"""Beyond this change of light the pipeline calls a picture unlike the no-contact image."""


class EncodedImagePerception:
    """error: how the object is seen. mirrored: a turn is told the wrong way round, as by swapped pictures."""

    def __init__(self, error: SightError, rng: np.random.Generator) -> None:
        self.mirrored = False
        self.last_patch = None
        self._sight = ModelSight(error, rng)

    def keep_estimate(self, captured_at_s: float) -> None:
        """A frame that is not handed in: nothing here counts frames."""

    def reset_reference(self) -> None:
        """The next stable contact is the new one."""
        self._sight.reset()

    def process(self, frame: Frame) -> Estimate:
        """What the pipeline might say of a frame."""
        view, light = decode_view(frame.image)
        answer = self._sight.look(view, frame.captured_at_s, frame.sequence)
        if max(abs(level) for level in light) > BRIGHT_LEVELS:
            plain = replace(answer, angle_deg=None, sigma_deg=None, rate_deg_s=None, shift_mm=None)
            return replace(plain, contact=True, orientation_deg=None, declined=UNLIKE)
        if not answer.contact:
            return replace(answer, skipped="no contact", declined="no contact")
        if answer.angle_deg is None and answer.declined is None:
            return replace(answer, declined="no reference yet")
        if self.mirrored and answer.angle_deg is not None:
            return replace(answer, angle_deg=-answer.angle_deg, rate_deg_s=-(answer.rate_deg_s or 0.0))
        return answer
