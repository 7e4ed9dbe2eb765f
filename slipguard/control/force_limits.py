"""How hard the controller may grip: the forces that gripper and force limit allow, and the steps between them.

All forces are newtons per finger.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from slipguard.control.messages import Observation
from slipguard.control.params import GuardParams
from slipguard.limit_surface import Pad

REGISTER_COUNTS = 255
"""Steps of a Robotiq force register (one byte); 0.84 N each on a 2F-85, 20-235 N."""
SEEN_SHARE = 0.75
"""Of 117 rendered presses (39 objects, three depths), nine in ten hold the torque of a disk of at least this share of
the radius seen. Of all patches of one area a disk holds the least torque (Hardy, Littlewood and Polya)."""
UNSEEN_MM = 2.5
"""Radius of a contact that no camera shows: of the smallest that is measured well."""


@dataclass(frozen=True, slots=True)
class ForceRange:
    """The forces the controller may command: low_n, low_n + step_n, ... up to high_n, which is on that grid."""

    low_n: float
    high_n: float
    step_n: float

    def allowed(self, force_n: float, present_n: float) -> float:
        """Return the force to command: rounded up to the grid, within the range, never below the present one.

        A present force above the range (taken over from another program's grip) is kept.
        """
        if self.step_n > 0.0:
            counts = math.ceil((force_n - self.low_n) / self.step_n - 1e-9)
            force_n = self.low_n + counts * self.step_n
        return max(min(max(force_n, self.low_n), self.high_n), present_n)

    def raised(self, present_n: float, force_n: float) -> float:
        """Return the force to tighten to: at least one step more, as far as the range goes."""
        return self.allowed(max(force_n, present_n + self.step_n), present_n)


def force_range(force_max_n: float, gripper_limits_n: tuple[float, float]) -> ForceRange | None:
    """Return what `force_max_n` leaves of a gripper's range; None if it is below the gripper's weakest grip.

    The top is rounded down to the register's grid, so that a driver that rounds up stays within the force limit.
    """
    low_n, strongest_n = gripper_limits_n
    if force_max_n < low_n:
        return None
    step_n = (strongest_n - low_n) / REGISTER_COUNTS
    if step_n <= 0.0:
        return ForceRange(low_n, low_n, 0.0)
    counts = math.floor((min(force_max_n, strongest_n) - low_n) / step_n + 1e-9)
    return ForceRange(low_n, low_n + counts * step_n, step_n)


def present_range(params: GuardParams, observation: Observation) -> ForceRange | None:
    """Return what the configured force limit leaves of the present gripper's range, as `force_range` does."""
    return force_range(params.force_max_n, observation.gripper_limits_n)


def seen_pad(radius_mm: float | None, force_n: float) -> Pad:
    """Return the pad whose patch the cameras show at this force. radius_mm: None if they show none."""
    radius_m = 1e-3 * (UNSEEN_MM if radius_mm is None else SEEN_SHARE * radius_mm)
    return replace(Pad(), radius_m=radius_m / max(force_n, 1.0) ** Pad().gamma)


def first_n(params: GuardParams) -> float:
    """Return the first grip where the request names none: gentle, but no weaker than friction and mass require."""
    return max(params.first_force_n, params.modelled_n() or 0.0)
