"""How long a command takes to be felt, measured while the jaws close.

The jaws close with the first grip: from the command to the first change of their width is the line's and the motor's
share. Tightening later takes a transaction more (stop, then go).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from slipguard.devices import GripperState

MOVED_MM = 0.5
"""A count of a Robotiq's position is 0.37 mm."""
STOP_AND_GO_S = 0.016
"""One transaction more than closing takes."""


@dataclass(frozen=True, slots=True)
class GripperDelay:
    """asked_s, from_mm: the order to close being timed. felt_s: from an order to its first effect; None: not known."""

    asked_s: float | None = None
    from_mm: float = 0.0
    felt_s: float | None = None


def closing(delay: GripperDelay, commanded_s: float, gripper: GripperState | None) -> GripperDelay:
    """What is known after one more look at jaws that were told to close at `commanded_s`."""
    if gripper is None:
        return delay
    if delay.asked_s != commanded_s:
        return replace(delay, asked_s=commanded_s, from_mm=gripper.width_mm)
    moved = delay.from_mm - gripper.width_mm > MOVED_MM
    if not moved or delay.felt_s is not None:
        return delay
    return replace(delay, felt_s=max(gripper.measured_at_s - commanded_s, 0.0) + STOP_AND_GO_S)
