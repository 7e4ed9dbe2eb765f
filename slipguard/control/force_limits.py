"""How hard the law may grip: the budget of a grasp on a given gripper, and the steps within it.

All forces are newtons per finger.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from slipguard.control.params import GuardParams

REGISTER_COUNTS = 255
"""Steps of a Robotiq force register (one byte); 0.84 N each on a 2F-85, 20-235 N."""


@dataclass(frozen=True, slots=True)
class ForceRange:
    """The forces the law may command: low_n, low_n + step_n, ... up to high_n, which is on that grid."""

    low_n: float
    high_n: float
    step_n: float


def budget(force_max_n: float, gripper_limits_n: tuple[float, float]) -> ForceRange | None:
    """What `force_max_n` leaves of a gripper's range; None if it allows less than the gripper's weakest grip.

    The top is rounded down to the register's grid, so that a driver that rounds up stays within the budget.
    """
    low_n, strongest_n = gripper_limits_n
    if force_max_n < low_n:
        return None
    step_n = (strongest_n - low_n) / REGISTER_COUNTS
    if step_n <= 0.0:
        return ForceRange(low_n, low_n, 0.0)
    counts = math.floor((min(force_max_n, strongest_n) - low_n) / step_n + 1e-9)
    return ForceRange(low_n, low_n + counts * step_n, step_n)


def allowed(force_n: float, present_n: float, within: ForceRange) -> float:
    """The force to command when `force_n` is wanted: rounded up to the grid, in the budget, never below the present.

    A present force above the budget (adopted from somebody else's grip) is kept.
    """
    if within.step_n > 0.0:
        counts = math.ceil((force_n - within.low_n) / within.step_n - 1e-9)
        force_n = within.low_n + counts * within.step_n
    return max(min(max(force_n, within.low_n), within.high_n), present_n)


def firm_n(params: GuardParams, gripper_limits_n: tuple[float, float]) -> float:
    """The force that is tightened to at once: what friction and mass ask for where they are given, else a share of the
    budget; infinite where there is no budget.
    """
    within = budget(params.force_max_n, gripper_limits_n)
    if within is None:
        return math.inf
    modelled_n = params.modelled_n
    return params.tuning.first_fraction * within.high_n if modelled_n is None else min(modelled_n, within.high_n)


def first_n(params: GuardParams) -> float:
    """The first grip where none is asked for: gentle, but no weaker than friction and mass ask for."""
    return max(params.first_force_n, params.modelled_n or 0.0)


def raised(present_n: float, multiple: float, within: ForceRange) -> float:
    """The next force when tightening by `multiple`: at least one step of the grid more, as far as the budget goes."""
    return allowed(max(present_n * multiple, present_n + within.step_n), present_n, within)


def multiple(base: float, rate_deg_s: float, per_100_deg_s: float) -> float:
    """By how much to tighten an object turning at `rate_deg_s`: the faster it turns, the more force it lacks."""
    return base + per_100_deg_s * max(rate_deg_s, 0.0) / 100.0
