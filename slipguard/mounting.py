"""Whether an arm is mounted upright. slipguard lifts along the z axis of the arm's base, so that axis must point up."""

from __future__ import annotations

import math

TILT_MAX_DEG = 10.0
"""An arm that lifts along an axis which is tilted further moves sideways by more than a sixth of the way."""


def tilt_deg(up: tuple[float, float, float]) -> float:
    """Return the angle between up and the z axis of the arm's base, 0 to 180. up: see `slipguard.devices.ArmState`."""
    x, y, z = up
    return math.degrees(math.atan2(math.hypot(x, y), z))


def mounting_name(tilt: float) -> str:
    """Return how an arm is mounted, by its tilt in degrees."""
    if tilt <= TILT_MAX_DEG:
        return "upright"
    if tilt >= 150.0:
        return "on the ceiling"
    return "on a wall" if 60.0 <= tilt <= 120.0 else "at a tilt"
