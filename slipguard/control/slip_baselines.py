"""Baselines of the slip detector: the angles and shifts from which motion of a held object counts."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from slipguard.control.finger_fusion import FusedEstimate
from slipguard.control.params import GuardParams

SHIFT_TAU_S = 0.05
"""Time constant of the filtered derivative of the shift: three frames at 60 fps."""
SETTLED_SHIFT_MM = 0.3
"""A contact center that wanders less than this is at rest; its noise is about 0.05 mm."""
SWITCH_SHIFT_MM = 2.5
"""Without a rotation, the shifts of two fingers may differ by this; the shift of a finger errs by as much."""
SWITCH_MAX_DEG = 2.0
"""Two fingers differ by no more than this in total; more is motion of the object."""


@dataclass(frozen=True, slots=True)
class Baselines:
    """The angles (and shifts) from which motion of the object counts. None: unknown.

        rotation
           ^                            * frame        while the arm is at rest:
           |                          *                  frame - previous_deg   the sensor's noise
           |   - - - - - - - - - - -*- - - resting_deg   frame - resting_deg    slip if above a fraction of a degree
           |  ______settled_deg______                    frame - settled_deg    not settled if above settle_deg
           | _____episode_deg____________                frame - episode_deg    slip if above 2 degrees and fast
           |___before_motion_deg_____________> time      frame - before_motion_deg   still there at rest: slip

    Args:
        episode_deg, episode_mm, sideways_mm: where the object was when the last slip episode ended, or at the start.
        settled_deg, settled_mm, settled_side_mm, settled_since_s: where it has been within the settling tolerance, and
            since when.
        resting_deg: where it rests, slowly followed; while the arm moves: where it last rested.
        previous_deg: the frame before, at rest.
        before_motion_deg: where it rested before the arm's motions, as long as none has rotated it.
        unloaded_deg, unloaded_mm (down and sideways): from where elastic motion counts, the reference or the end of the
            last slip episode.
    """

    episode_deg: float | None = None
    episode_mm: float | None = None
    settled_deg: float | None = None
    settled_mm: float | None = None
    settled_since_s: float | None = None
    resting_deg: float | None = None
    previous_deg: float | None = None
    before_motion_deg: float | None = None
    sideways_mm: float | None = None
    settled_side_mm: float | None = None
    unloaded_deg: float | None = 0.0
    unloaded_mm: tuple[float, float] | None = (0.0, 0.0)

    def moved(self, by_deg: float, by_mm: float = 0.0, sideways_mm: float = 0.0) -> Baselines:
        """Return the same baselines as fingers see them whose estimates differ by this offset."""
        return Baselines(
            plus(self.episode_deg, by_deg),
            plus(self.episode_mm, by_mm),
            plus(self.settled_deg, by_deg),
            plus(self.settled_mm, by_mm),
            self.settled_since_s,
            plus(self.resting_deg, by_deg),
            plus(self.previous_deg, by_deg),
            plus(self.before_motion_deg, by_deg),
            plus(self.sideways_mm, sideways_mm),
            plus(self.settled_side_mm, sideways_mm),
            plus(self.unloaded_deg, by_deg),
            None if self.unloaded_mm is None else (self.unloaded_mm[0] + by_mm, self.unloaded_mm[1] + sideways_mm),
        )

    def with_settled(self, fused: FusedEstimate, params: GuardParams) -> Baselines:
        """Return where the object has settled and since when: within `settle_deg` (or two sigma) and 0.3 mm."""
        tuning = params.tuning
        settle_deg = max(tuning.settle_deg, min(2.0 * (fused.sigma_deg or 0.0), tuning.sigma_threshold_max_deg))
        near = _near(fused.rotation_deg, self.settled_deg, settle_deg)
        near = near and _near(fused.shift_mm, self.settled_mm, SETTLED_SHIFT_MM)
        near = near and _near(fused.sideways_mm, self.settled_side_mm, SETTLED_SHIFT_MM)
        if near and self.settled_since_s is not None:
            return replace(
                self,
                settled_deg=fused.rotation_deg if self.settled_deg is None else self.settled_deg,
                settled_mm=fused.shift_mm if self.settled_mm is None else self.settled_mm,
                settled_side_mm=fused.sideways_mm if self.settled_side_mm is None else self.settled_side_mm,
            )
        return replace(
            self,
            settled_deg=fused.rotation_deg,
            settled_mm=fused.shift_mm,
            settled_side_mm=fused.sideways_mm,
            settled_since_s=fused.captured_at_s,
        )


@dataclass(frozen=True, slots=True)
class FingerSwitch:
    """A switch to fingers whose offset is unknown yet: what was estimated just before.

    by_deg: the offset of the first frame. newest_at_s: of the measurements it comes from.
    """

    last_deg: float
    last_s: float
    resting_deg: float | None
    by_deg: float = 0.0
    newest_at_s: float = -math.inf

    def offset_deg(self, fused: FusedEstimate, total_deg: float) -> float:
        """Return how far the new fingers are from the former ones, less what the object has rotated since."""
        rotation_deg = fused.rotation_deg or 0.0
        rotated_deg = (fused.rate_deg_s or 0.0) * (fused.captured_at_s - self.last_s)
        by_deg = rotation_deg - self.last_deg - rotated_deg
        if self.resting_deg is not None:
            by_deg = min(by_deg, rotation_deg - self.resting_deg, key=abs)
        return within(total_deg + by_deg, SWITCH_MAX_DEG) - total_deg


@dataclass(frozen=True, slots=True)
class ReportingFingers:
    """Which fingers the estimate comes from, and the offset between fingers.

    Args:
        names: the fingers of the last estimate. last_deg, last_s: that estimate and when it was captured.
        total_deg: by how much all switches together have moved the baselines.
        known: that total for each set of fingers that has reported.
        switch: the last switch, until a second frame has confirmed its offset.
    """

    names: tuple[str, ...] = ()
    last_deg: float = 0.0
    last_s: float = 0.0
    total_deg: float = 0.0
    known: tuple[tuple[tuple[str, ...], float], ...] = ()
    switch: FingerSwitch | None = None


@dataclass(frozen=True, slots=True)
class ShiftFilter:
    """The smoothed shift along one axis, and its rate."""

    smooth_mm: float | None = None
    rate_mm_s: float = 0.0

    def next(self, shift_mm: float | None, passed_s: float) -> ShiftFilter:
        """Return the filter after one more shift. passed_s: since the one before."""
        if shift_mm is None:
            return replace(self, rate_mm_s=0.0)
        if self.smooth_mm is None:
            return replace(self, smooth_mm=shift_mm)
        if passed_s <= 0.0:
            return self
        share = 1.0 - math.exp(-passed_s / SHIFT_TAU_S)
        smooth_mm = self.smooth_mm + share * (shift_mm - self.smooth_mm)
        return ShiftFilter(smooth_mm, (shift_mm - smooth_mm) / SHIFT_TAU_S)

    def jump_mm(self, shift_mm: float | None) -> float:
        """Return by how much a shift differs from what the last ones lead to, within SWITCH_SHIFT_MM."""
        if shift_mm is None or self.smooth_mm is None:
            return 0.0
        return within(shift_mm - self.smooth_mm - self.rate_mm_s * SHIFT_TAU_S, SWITCH_SHIFT_MM)

    def moved(self, by_mm: float) -> ShiftFilter:
        """Return the same filter for fingers whose shifts differ by this."""
        return replace(self, smooth_mm=plus(self.smooth_mm, by_mm))


def plus(value: float | None, by: float) -> float | None:
    """Return the sum; None stays None."""
    return None if value is None else value + by


def _near(value: float | None, other: float | None, within: float) -> bool:
    return value is None or other is None or abs(value - other) <= within


def within(value: float, most: float) -> float:
    """Return the value, limited to -most to most."""
    return min(max(value, -most), most)
