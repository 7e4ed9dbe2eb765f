"""Two clocks, one motion: the lag between the external camera and the tactile stream, from the turns they tell."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
LAG_MAX_S = 0.5
STEP_S = 0.002
FINE_S = 1.0
COARSE_S = 0.03
"""Ranges above `FINE_S` are searched in these steps first: a camera's frame time."""
MOTION_MIN_DEG = 2.0
"""Less motion than this and any lag fits."""
OVERLAP_MIN = 0.5
GAP_FRAMES = 2.5
"""Pictures further apart than this many usual steps have a gap between them."""


@dataclass(frozen=True, slots=True)
class ClockLag:
    """lag_s: by how much the camera's times are late against the tactile ones. sigma_s: how well that is known.

    why: where it cannot be told, then lag_s is 0 and sigma_s the whole range.
    """

    lag_s: float
    sigma_s: float
    why: str | None = None


def find_lag(
    camera_s: Array, camera_deg: Array, tactile_s: Array, tactile_deg: Array, lag_max_s: float = LAG_MAX_S
) -> ClockLag:
    """The lag at which both turns differ least, up to a constant: the two zeros are not the same moment's.

    Times (n,) and (m,) in seconds, increasing; turns in degrees, of the same sign.
    """
    if min(len(camera_s), len(tactile_s)) < 5:
        return ClockLag(0.0, lag_max_s, "too few frames")
    if np.ptp(camera_deg) < MOTION_MIN_DEG or np.ptp(tactile_deg) < MOTION_MIN_DEG:
        return ClockLag(0.0, lag_max_s, "hardly any turn")
    around_s, reach_s = 0.0, lag_max_s
    while reach_s > FINE_S:  # a film that somebody else started: coarsely first
        lags = around_s + np.arange(-reach_s, reach_s + COARSE_S / 2, COARSE_S)
        cost = np.array([_spread(camera_s - lag, camera_deg, tactile_s, tactile_deg) for lag in lags])
        if not np.isfinite(cost).any():
            return ClockLag(0.0, lag_max_s, "the two streams do not overlap")
        around_s, reach_s = float(lags[int(np.nanargmin(cost))]), 0.2
    lags = around_s + np.arange(-reach_s, reach_s + STEP_S / 2, STEP_S)
    cost = np.array([_spread(camera_s - lag, camera_deg, tactile_s, tactile_deg) for lag in lags])
    if not np.isfinite(cost).any():
        return ClockLag(0.0, lag_max_s, "the two streams do not overlap")
    best = int(np.nanargmin(cost))
    if best in (0, len(lags) - 1):
        return ClockLag(0.0, lag_max_s, f"more than {lag_max_s:g} s apart")
    lag = float(lags[best]) + _vertex(cost[best - 1 : best + 2]) * STEP_S
    return ClockLag(lag, _sigma(camera_s - lag, camera_deg, tactile_s, tactile_deg, float(cost[best])))


def between_frames(time_s: Array, camera_s: Array) -> NDArray[np.bool_]:
    """Where the camera saw both markers just before and just after: what lies in a gap is not known."""
    if len(camera_s) < 2:
        return np.zeros(len(time_s), bool)
    steps = np.diff(camera_s)
    after = np.clip(np.searchsorted(camera_s, time_s), 1, len(camera_s) - 1)
    inside = (time_s >= camera_s[0]) & (time_s <= camera_s[-1])
    return np.asarray(inside & (steps[after - 1] <= GAP_FRAMES * np.median(steps)))


def _spread(camera_s: Array, camera_deg: Array, tactile_s: Array, tactile_deg: Array) -> float:
    """Variance of the difference where both streams have something to say; NaN where that is too little."""
    inside = between_frames(tactile_s, camera_s)
    if inside.mean() < OVERLAP_MIN:
        return float("nan")
    return float(np.var(tactile_deg[inside] - np.interp(tactile_s[inside], camera_s, camera_deg)))


def _vertex(three: Array) -> float:
    """Where the parabola through three neighbouring values is lowest, in steps from the middle one."""
    bend = three[0] - 2.0 * three[1] + three[2]
    return float(np.clip(0.5 * (three[0] - three[2]) / bend, -1.0, 1.0)) if bend > 0.0 else 0.0


def _sigma(camera_s: Array, camera_deg: Array, tactile_s: Array, tactile_deg: Array, variance: float) -> float:
    """Noise over slope: the more the turn changes, the better a shift is known."""
    inside = between_frames(tactile_s, camera_s)
    rate = np.gradient(np.interp(tactile_s[inside], camera_s, camera_deg), tactile_s[inside])
    power = float(((rate - rate.mean()) ** 2).sum())
    return float(np.sqrt(variance / power)) if power > 0.0 else float("inf")
