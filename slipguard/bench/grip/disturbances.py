"""What happens to a held object: a contact, an acceleration, taps and shaking. Functions of time."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from slipguard.limit_surface import GRAVITY_M_S2

SHAKE_HZ, SHAKE_MM = 12.0, 0.5
TAP_SHARE, TAP_S, TAP_EVERY_S = 0.06, (0.1, 0.4), 3.0
"""Additional load by a tap, relative to the weight."""


def pushed(force_n: float, lever_m: float, part: float) -> tuple[float, float]:
    """Return force and torque of a contact after this part of its onset; it stays."""
    part = min(max(part, 0.0), 1.0)
    return part * force_n, part * force_n * lever_m


def pulse(part: float) -> float:
    """Return a smooth pulse over three onsets, with the peak in the middle one."""
    return max(min(part, 1.0, 3.0 - part), 0.0)


def taps_and_shaking(rng: np.random.Generator, from_s: float, seconds: float) -> Callable[[float], float]:
    """Return the acceleration over time, upwards: shaking in the first half of the time, and taps."""
    rate = 2.0 * math.pi * SHAKE_HZ
    peak_m_s2 = 1e-3 * SHAKE_MM * rate * rate
    taps = [
        (from_s + float(rng.uniform(0.0, seconds)), float(rng.uniform(*TAP_S)), float(rng.choice((-1.0, 1.0))))
        for _ in range(max(round(seconds / TAP_EVERY_S), 1))
    ]

    def acceleration(now_s: float) -> float:
        value = peak_m_s2 * math.sin(rate * (now_s - from_s)) if now_s < from_s + 0.5 * seconds else 0.0
        for at_s, lasts_s, side in taps:
            if at_s <= now_s < at_s + lasts_s:
                value += side * TAP_SHARE * GRAVITY_M_S2 * math.sin(math.pi * (now_s - at_s) / lasts_s)
        return value

    return acceleration
