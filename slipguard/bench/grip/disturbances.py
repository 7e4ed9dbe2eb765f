"""What disturbs a stable hold and moves nothing: vibration, a touch, light, single wrong frames, a blind finger.

All of it is drawn from a generator, so that the same hold is disturbed alike each time.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from slipguard.bench.grip.loop import FINGERS
from slipguard.bench.grip.modeled_perception import Drift, Outliers
from slipguard.sim.friction import GRAVITY_M_S2

SHAKE_M_S2 = (0.05, 0.3)
SHAKE_HZ = (8.0, 25.0)
TOUCH_SHARE = 0.06
"""A passing touch: so much of the weight more, for a moment."""
TOUCH_S = (0.1, 0.4)
TOUCH_EVERY_S = 15.0
DRIFT_DEG = 0.15
DRIFT_S = (20.0, 60.0)
OUTLIER_DEG = 0.6
"""A single frame in which both fingers tell the same turn that is none: a smear or flicker that both cameras share."""
OUTLIER_EVERY_S = 12.0
OUTAGE_S = (0.05, 0.8)
OUTAGE_EVERY_S = 20.0
"""One finger's frames fail to come for a while; the other one sees."""


def drift(rng: np.random.Generator) -> Drift:
    """What a slow change of the light does to one finger's turns."""
    return Drift(DRIFT_DEG, float(rng.uniform(*DRIFT_S)), float(rng.uniform(0.0, 2.0 * math.pi)))


def outliers(rng: np.random.Generator, from_s: float, seconds: float) -> dict[str, Outliers]:
    """By finger: the same moments and the same turn of the object, which has opposite signs in their pictures."""
    times_s = sorted(from_s + float(rng.uniform(0.0, seconds)) for _ in range(_count(seconds, OUTLIER_EVERY_S)))
    deg = float(rng.choice((-1.0, 1.0))) * OUTLIER_DEG
    return {finger: Outliers(times_s, sign * deg) for finger, sign in zip(FINGERS, (1.0, -1.0), strict=True)}


def outages(rng: np.random.Generator, from_s: float, seconds: float) -> Callable[[str, float], bool]:
    """When which finger's frames fail to come."""
    each = [
        (str(rng.choice(FINGERS)), from_s + float(rng.uniform(0.0, seconds)), float(rng.uniform(*OUTAGE_S)))
        for _ in range(_count(seconds, OUTAGE_EVERY_S))
    ]
    return lambda finger, now_s: any(finger == one and at_s <= now_s < at_s + lasts_s for one, at_s, lasts_s in each)


def shaking(rng: np.random.Generator, from_s: float, seconds: float) -> Callable[[float], float]:
    """The arm's vibration all the time, and now and then a passing touch: acceleration by time, m/s2, up."""
    amplitude, hz = float(rng.uniform(*SHAKE_M_S2)), float(rng.uniform(*SHAKE_HZ))
    touches = [
        (from_s + float(rng.uniform(0.0, seconds)), float(rng.uniform(*TOUCH_S)), float(rng.choice((-1.0, 1.0))))
        for _ in range(_count(seconds, TOUCH_EVERY_S))
    ]

    def shaken(now_s: float) -> float:
        value = amplitude * math.sin(2.0 * math.pi * hz * now_s)
        for at_s, lasts_s, side in touches:
            if at_s <= now_s < at_s + lasts_s:
                value += side * TOUCH_SHARE * GRAVITY_M_S2 * math.sin(math.pi * (now_s - at_s) / lasts_s)
        return value

    return shaken


def _count(seconds: float, every_s: float) -> int:
    return max(round(seconds / every_s), 1)
