"""What happens to a held object: a contact that stays, an acceleration, vibration, a bump. Functions of time."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

PEAK_M_S2 = 2.0
"""Of the arm's acceleration, and of the vibration."""
VIBRATION_HZ = (10.0, 30.0)
BUMP_SHARE, BUMP_S = 0.5, 0.06
"""Additional load by a bump, relative to the weight, and its duration."""
LASTS_S = 2.0
"""Duration of each disturbance with the rest after it."""


@dataclass(frozen=True, slots=True)
class Disturbance:
    """One disturbance. Both functions of the time since it began; of a time beyond the disturbance, too.

    acceleration_m_s2: of the fingers, up. push_share: additional load at the center of mass, relative to the weight.
    """

    acceleration_m_s2: Callable[[float], float] | None = None
    push_share: Callable[[float], float] | None = None


def pushed(force_n: float, lever_m: float, part: float) -> tuple[float, float]:
    """Return force and torque of a contact after this part of its onset; it stays."""
    part = min(max(part, 0.0), 1.0)
    return part * force_n, part * force_n * lever_m


def pulse(part: float) -> float:
    """Return a smooth pulse over three onsets, with the peak in the middle one."""
    return max(min(part, 1.0, 3.0 - part), 0.0)


def _starts_and_stops(time_s: float) -> float:
    """Return the acceleration of an arm that starts upwards and stops again."""
    return PEAK_M_S2 * (pulse(time_s / 0.1) - pulse((time_s - 0.6) / 0.1))


def _sweep(time_s: float) -> float:
    """Return a vibration whose frequency rises."""
    low, high = VIBRATION_HZ
    time_s = min(time_s, 0.75 * LASTS_S)
    phase = low * time_s + 0.5 * (high - low) * time_s**2 / (0.75 * LASTS_S)
    return PEAK_M_S2 * math.sin(2.0 * math.pi * phase) * (time_s < 0.75 * LASTS_S)


def _bump(time_s: float) -> float:
    return BUMP_SHARE * math.sin(math.pi * time_s / BUMP_S) if 0.0 <= time_s < BUMP_S else 0.0


DISTURBANCES = {
    "arm at 2 m/s²": Disturbance(acceleration_m_s2=_starts_and_stops),
    "vibration 10-30 Hz": Disturbance(acceleration_m_s2=_sweep),
    "bump": Disturbance(push_share=_bump),
}
LOWERING = "lowering"
"""The object is put down as it was lifted; the far end of a rotated one meets the table first."""
