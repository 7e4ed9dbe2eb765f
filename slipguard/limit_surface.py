"""Load and torque that a soft fingertip holds before it slips: closed forms, for controller and simulation.

One fingertip presses with a force N on a round patch of radius a(N) = delta N^gamma (Xydas & Kao 1999) and holds any
tangential load f and torque tau inside the ellipsoid (f / (mu N))^2 + (tau / tau_max)^2 <= 1 (Howe & Cutkosky 1996).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

from slipguard.errors import InputError

GRAVITY_M_S2 = 9.80665
FINGER_COUNT = 2
NO_CONTACT_N = 1e-6
"""Below this force a finger counts as not touching."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Pad:
    """radius_m, gamma: contact radius is radius_m * N^gamma (4.353 mm N^-gamma and 0.2569: Costanzo et al.).

    pressure_k: pressure ~ (1 - (r/a)^k)^(1/k); 2 is Hertz, infinity uniform.
    """

    radius_m: float = 4.353e-3
    gamma: float = 0.2569
    pressure_k: float = 4.0

    def contact_radius_m(self, force_n: float) -> float:
        """Return the radius of the contact patch at this force."""
        return self.radius_m * math.pow(max(force_n, 0.0), self.gamma)


@lru_cache(maxsize=32)
def pressure_shape(k: float) -> float:
    """Return the factor xi nu of the pressure profile: 3 pi / 32 for Hertz (k = 2), 1/3 for uniform (k infinite).

    xi nu = (3/8) Gamma(3/k)^2 / (Gamma(2/k) Gamma(4/k)); from slipping_control (Costanzo et al.). k > 0.
    """
    if not k > 0.0:
        raise InputError(f"pressure exponent is {k}; it must be above 0: 2 (Hertz) to infinity (uniform)")
    if k > 1e6:
        return 1.0 / 3.0
    log = 2 * math.lgamma(3 / k) - math.lgamma(2 / k) - math.lgamma(4 / k)
    return 0.375 * math.exp(log)


def torque_limit_n_m(force_n: float, friction: float, pad: Pad, tangential_n: float = 0.0) -> float:
    """Return the torque one finger holds while it carries `tangential_n`; 0 if the load alone makes it slip.

    tau_max = 2 mu xi_nu delta N^(1 + gamma), multiplied by sqrt(1 - (f / (mu N))^2).
    """
    if force_n <= NO_CONTACT_N:
        return 0.0
    share = tangential_n / (friction * force_n)
    if abs(share) >= 1.0:
        return 0.0
    full = 2.0 * friction * pressure_shape(pad.pressure_k) * pad.contact_radius_m(force_n) * force_n
    return full * math.sqrt(1.0 - share * share)


def force_needed_n(load_n: float, lever_m: float, friction: float, pad: Pad) -> float:
    """Return the smallest force at which a finger that carries `load_n` at a lever slips in neither way.

    Solves (f / (mu N))^2 + (tau / tau_max(N))^2 = 1 with tau = f * lever by bisection to 1e-12 relative. 0 for no load,
    at least `NO_CONTACT_N` otherwise.
    """
    if load_n == 0.0:
        return 0.0
    torque_n_m = load_n * lever_m

    def overload(force_n: float) -> float:
        return (load_n / (friction * force_n)) ** 2 + (torque_n_m / torque_limit_n_m(force_n, friction, pad)) ** 2

    low = max(load_n / friction, NO_CONTACT_N)  # needed against translational slip alone
    high = 2.0 * low
    while overload(high) > 1.0:
        high *= 2.0
    while high - low > 1e-12 * high:
        middle = 0.5 * (low + high)
        if middle in (low, high):
            break
        low, high = (middle, high) if overload(middle) > 1.0 else (low, middle)
    return high
