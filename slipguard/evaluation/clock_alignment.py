"""The lag between the clocks of the external camera and the tactile sensors, from the rotations both measure."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
LAG_MAX_S = 0.5
STEP_S = 0.002
FINE_S = 1.0
COARSE_S = 0.03
"""Ranges above `FINE_S` are searched in these steps first: about a camera's frame period."""
MOTION_MIN_DEG = 2.0
"""With less motion any lag fits."""
OVERLAP_MIN = 0.5
GAP_FRAMES = 2.5
"""Images further apart than this many median periods have a gap between them."""


@dataclass(frozen=True, slots=True)
class ClockLag:
    """lag_s: delay of the camera's times relative to the tactile ones. why: reason if it is unknown; then it is 0."""

    lag_s: float
    why: str | None = None


def find_lag(
    camera_s: Array, camera_deg: Array, tactile_s: Array, tactile_deg: Array, lag_max_s: float = LAG_MAX_S
) -> ClockLag:
    """Return the lag at which both rotations differ least, up to a constant offset.

    Args:
        camera_s, tactile_s: times (n,) and (m,), increasing.
        camera_deg, tactile_deg: rotations of the same sign.
        lag_max_s: largest lag considered.
    """
    if min(len(camera_s), len(tactile_s)) < 5:
        return ClockLag(0.0, "too few frames")
    if np.ptp(camera_deg) < MOTION_MIN_DEG or np.ptp(tactile_deg) < MOTION_MIN_DEG:
        return ClockLag(0.0, "too little rotation")
    around_s, reach_s = 0.0, lag_max_s
    while reach_s > FINE_S:  # a separate video: coarse search first
        lags = around_s + np.arange(-reach_s, reach_s + COARSE_S / 2, COARSE_S)
        cost = np.array([_difference_variance(camera_s - lag, camera_deg, tactile_s, tactile_deg) for lag in lags])
        if not np.isfinite(cost).any():
            return ClockLag(0.0, "the two streams do not overlap")
        around_s, reach_s = float(lags[int(np.nanargmin(cost))]), 0.2
    lags = around_s + np.arange(-reach_s, reach_s + STEP_S / 2, STEP_S)
    cost = np.array([_difference_variance(camera_s - lag, camera_deg, tactile_s, tactile_deg) for lag in lags])
    if not np.isfinite(cost).any():
        return ClockLag(0.0, "the two streams do not overlap")
    best = int(np.nanargmin(cost))
    if best in (0, len(lags) - 1):
        return ClockLag(0.0, f"more than {lag_max_s:g} s apart")
    return ClockLag(float(lags[best]) + _vertex(cost[best - 1 : best + 2]) * STEP_S)


def between_frames(time_s: Array, camera_s: Array) -> NDArray[np.bool_]:
    """Return where the camera saw both markers just before and just after, so not in a gap."""
    if len(camera_s) < 2:
        return np.zeros(len(time_s), bool)
    steps = np.diff(camera_s)
    after = np.clip(np.searchsorted(camera_s, time_s), 1, len(camera_s) - 1)
    inside = (time_s >= camera_s[0]) & (time_s <= camera_s[-1])
    return np.asarray(inside & (steps[after - 1] <= GAP_FRAMES * np.median(steps)))


def _difference_variance(camera_s: Array, camera_deg: Array, tactile_s: Array, tactile_deg: Array) -> float:
    """Return the variance of the difference where both streams have data; NaN if the overlap is too small."""
    inside = between_frames(tactile_s, camera_s)
    if inside.mean() < OVERLAP_MIN:
        return float("nan")
    return float(np.var(tactile_deg[inside] - np.interp(tactile_s[inside], camera_s, camera_deg)))


def _vertex(three: Array) -> float:
    """Return the minimum of the parabola through three neighboring values, in steps from the middle one."""
    curvature = three[0] - 2.0 * three[1] + three[2]
    return float(np.clip(0.5 * (three[0] - three[2]) / curvature, -1.0, 1.0)) if curvature > 0.0 else 0.0
