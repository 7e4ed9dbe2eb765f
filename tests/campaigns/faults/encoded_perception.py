"""A perception model for encoded images: the estimates that the pipeline would give, without image processing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from slipguard.bench.grip.perception_models import ModeledFinger, PerceptionErrors
from slipguard.devices import Frame
from slipguard.perception.declined import DeclineReason
from slipguard.perception.estimate import Estimate
from slipguard.sim.gel_view import decode_view

BRIGHT_LEVELS = 30.0
"""With a larger change of light the pipeline declines: the frame does not match the background image."""


class EncodedImagePerception:
    """Estimates with the errors of `error`. mirrored: rotations have the wrong sign, as with swapped cameras."""

    def __init__(self, error: PerceptionErrors, rng: np.random.Generator) -> None:
        self.mirrored = False
        self.last_patch = None
        self._model = ModeledFinger(error, rng)

    def keep_estimate(self, captured_at_s: float) -> None:
        """Do nothing for a skipped frame."""

    def reset_reference(self) -> None:
        """Take a new reference from the next stable contact."""
        self._model.reset()

    def process(self, frame: Frame) -> Estimate:
        """Return the estimate of one frame."""
        view, light = decode_view(frame.image)
        estimate = self._model.process(view, frame.captured_at_s, frame.sequence)
        if max(abs(level) for level in light) > BRIGHT_LEVELS:
            plain = replace(estimate, rotation_deg=None, sigma_deg=None, rate_deg_s=None, shift_mm=None)
            return replace(plain, contact=True, orientation_deg=None, declined=str(DeclineReason.IMAGE))
        if not estimate.contact:
            return replace(estimate, skipped="no contact", declined="no contact")
        if estimate.rotation_deg is None and estimate.declined is None:
            return replace(estimate, declined="no reference yet")
        if self.mirrored and estimate.rotation_deg is not None:
            return replace(estimate, rotation_deg=-estimate.rotation_deg, rate_deg_s=-(estimate.rate_deg_s or 0.0))
        return estimate
