"""Perception for hours of virtual time: the real pipeline without contact, the world's truth with noise in contact."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from slipguard.daemon.loop.finger import PerceptionPipeline
from slipguard.devices import Frame
from slipguard.perception.estimate import Estimate
from slipguard.perception.patch import Patch
from slipguard.sim.world import World

SIGMA_DEG = 0.4
NOISE_MM = 0.03
STABLE_FRAMES = 5
AREA_PX = 4000
ALPHA, BETA = 0.5, 0.15
"""Rotation and rate gain of the tracking filter."""


class WorldTruthPerception:
    """Runs `pipeline` on frames without contact; in contact it estimates from the world's truth, within `SIGMA_DEG`.

    Args:
        sign: +1 for the left finger, -1 for the right one, which sees every rotation mirrored.
        now: return the loop's time, s.
    """

    def __init__(
        self, pipeline: PerceptionPipeline, world: World, sign: int, rng: np.random.Generator, now: Callable[[], float]
    ) -> None:
        self._pipeline, self._world, self._sign, self._rng, self._now = pipeline, world, sign, rng, now
        self._forget()

    @property
    def last_patch(self) -> Patch | None:
        """None in contact: there is no segmentation."""
        return self._pipeline.last_patch

    def keep_estimate(self, captured_at_s: float) -> None:
        """Record a frame that is skipped because the other finger shows no rotation."""
        self._pipeline.keep_estimate(captured_at_s)

    def reset_reference(self) -> None:
        """Take a new reference from the next stable contact."""
        self._pipeline.reset_reference()
        self._forget()

    def _forget(self) -> None:
        self._stable = 0
        self._reference: tuple[float, float] | None = None
        self._rotation_deg = self._rate_deg_s = self._tracked_s = 0.0

    def process(self, frame: Frame) -> Estimate:
        """Return the estimate of one frame. Raises FrameCorrupt as the pipeline does."""
        truth = self._world.truth(self._now())
        if not truth.in_contact:
            self._stable = 0
            return self._pipeline.process(frame)
        at_s = frame.captured_at_s
        plain = Estimate(frame.sequence, at_s, at_s, True, AREA_PX, "truth")
        rotation_deg = self._sign * truth.rotation_deg + self._rng.normal(0.0, SIGMA_DEG)
        slip_mm = truth.slip_mm + self._rng.normal(0.0, NOISE_MM)
        self._stable += 1
        if self._reference is None:
            if self._stable < STABLE_FRAMES:
                return replace(plain, declined="no reference yet")
            self._reference, self._tracked_s = (rotation_deg, slip_mm), at_s
        self._track(rotation_deg - self._reference[0], at_s)
        return replace(
            plain,
            rotation_deg=self._rotation_deg,
            sigma_deg=SIGMA_DEG,
            orientation_deg=0.0,
            rate_deg_s=self._rate_deg_s,
            shift_mm=(0.0, self._reference[1] - slip_mm),
        )

    def _track(self, rotation_deg: float, at_s: float) -> None:
        passed_s = max(at_s - self._tracked_s, 1e-3)
        expected_deg = self._rotation_deg + self._rate_deg_s * passed_s
        self._rotation_deg = expected_deg + ALPHA * (rotation_deg - expected_deg)
        self._rate_deg_s += BETA * (rotation_deg - expected_deg) / passed_s
        self._tracked_s = at_s
