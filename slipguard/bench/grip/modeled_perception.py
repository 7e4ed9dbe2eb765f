"""What the cameras would say, without drawing anything: the truth with the errors that the pipeline makes.

The errors were fitted to the estimates of `slipguard bench`'s grasps, object by object (`python -m tests.campaigns fit-perception-errors`): an
error that grows with the turn, drawn once a grasp; noise that is drawn each frame; frames without an answer.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from slipguard.perception.estimate import Estimate
from slipguard.perception.rotation.fusion import RotationEstimate
from slipguard.perception.rotation.rotation_tracker import RotationTracker
from slipguard.sim.gel_view import GelView

REFERENCE_FRAMES = 5
"""So many frames of a stable contact make a reference."""
SHIFT_NOISE_MM = 0.01


@dataclass(frozen=True, slots=True)
class SightError:
    """How one object is seen. noise_deg: of a frame. bias_per_deg: one standard deviation of the error over the turn.

    bias_deg: one standard deviation of an error that comes with the first degree of motion and stays.
    sigma_deg: what the estimate says of itself. declined: share of the frames without a turn.
    """

    noise_deg: float = 0.03
    bias_per_deg: float = 0.01
    bias_deg: float = 0.05
    sigma_deg: float = 0.06
    declined: float = 0.0


@dataclass(frozen=True, slots=True)
class Drift:
    """What a slow change of the light does to a turn: to and fro by `deg` with this period and phase."""

    deg: float = 0.0
    period_s: float = 30.0
    phase: float = 0.0

    def at(self, now_s: float) -> float:
        """Degrees at a time."""
        return self.deg * math.sin(2.0 * math.pi * (now_s / self.period_s) + self.phase)


@dataclass(frozen=True, slots=True)
class Outliers:
    """Single frames that are off by `deg`: the first one captured at or after each of these times, in their order."""

    times_s: Sequence[float] = ()
    deg: float = 0.0


class ModelSight:
    """One finger of one trial. Same calls as `RenderedSight`."""

    def __init__(self, error: SightError, rng: np.random.Generator, drift: Drift | None = None) -> None:
        self._error, self._rng, self._drift = error, rng, drift or Drift()
        self._off: deque[tuple[float, float]] = deque()
        self._bias_per_deg = float(rng.normal(0.0, error.bias_per_deg))
        self._bias_deg = float(rng.normal(0.0, error.bias_deg))
        self._areas: deque[float] = deque(maxlen=REFERENCE_FRAMES)
        self._tracker = RotationTracker()
        self._reference: tuple[float, float, float] | None = None

    def reset(self) -> None:
        """The next stable contact is the new reference."""
        self._reference = None
        self._areas.clear()

    def err_at(self, outliers: Outliers) -> None:
        """From now on these frames are off."""
        self._off = deque((time_s, outliers.deg) for time_s in outliers.times_s)

    def look(self, view: GelView, captured_at_s: float, sequence: int) -> Estimate:
        """What the pipeline might say of the frame exposed now."""
        contact = view.depth_mm > 0.0 and view.object_name != ""
        plain = Estimate(sequence, captured_at_s, captured_at_s, contact, 4000 if contact else 0, "model")
        if not contact:
            self._areas.clear()
            return plain
        self._areas.append(view.depth_mm)
        seen_deg = view.angle_deg + float(self._rng.normal(0.0, self._error.noise_deg)) + self._drift.at(captured_at_s)
        if self._off and captured_at_s >= self._off[0][0]:
            seen_deg += self._off.popleft()[1]
        if self._reference is None:
            if len(self._areas) < REFERENCE_FRAMES:
                return plain
            self._reference = (view.angle_deg, seen_deg - view.angle_deg, view.y_mm)
            self._tracker.start(captured_at_s)
        start_deg, start_error_deg, start_y_mm = self._reference
        true_deg = view.angle_deg - start_deg
        shift_mm = (0.0, view.y_mm - start_y_mm + float(self._rng.normal(0.0, SHIFT_NOISE_MM)))
        if self._rng.random() < self._error.declined:
            return Estimate(
                sequence, captured_at_s, captured_at_s, True, 4000, "model", shift_mm=shift_mm, declined="too uncertain"
            )
        moved = math.tanh(true_deg)
        rotation_deg = seen_deg - start_deg - start_error_deg + self._bias_per_deg * true_deg + self._bias_deg * moved
        rotation = self._tracker.accept(captured_at_s, RotationEstimate(rotation_deg, self._error.sigma_deg))
        return Estimate(
            sequence,
            captured_at_s,
            captured_at_s,
            True,
            4000,
            "model",
            angle_deg=rotation.rotation_deg,
            sigma_deg=rotation.sigma_deg,
            orientation_deg=None if rotation.rotation_deg is None else 0.0,
            rate_deg_s=None if rotation.rotation_deg is None else self._tracker.rate_deg_s(captured_at_s),
            shift_mm=shift_mm,
            declined=rotation.declined,
        )
