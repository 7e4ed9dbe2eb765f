"""How much of its elastic limit a grip uses, and whether a load that grows will soon use it up.

A gel moves in proportion to its load until it slips (needed_force.py, item 4). While the arm stands and the object
hangs, only a load that grows makes it move, so the share of the elastic motion that is used, extrapolated over the
delay of the loop, says before any slip whether the grip will hold. Taps, shaking and drifting light grow neither for as
long nor as far.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from slipguard.control.finger_fusion import FusedEstimate
from slipguard.control.needed_force import ElasticMotion
from slipguard.control.slip_memory import ArmCase, SlipMemory

GROWS_LEAST = 0.15
"""A load that grows takes up at least this share per second."""
GROWS_S = 0.05
"""It has grown for this time; shaking at 12 Hz swings back after 42 ms."""
GROWS_MM = 0.15
GROWS_SHARE = 0.1
"""By then it has moved the contact by this, or rotated it by more than the estimate's error, and by this share of the
elastic limit: a gel that creeps moves by less in this time."""


@dataclass(frozen=True, slots=True)
class ElasticShare:
    """The share of the elastic motion that is used, of torsion and shear together (an ellipse); above 1 it slips.

    rate: per second.
    """

    used: float = 0.0
    rate: float = 0.0


NO_SHARE = ElasticShare()


def elastic_share(memory: SlipMemory, fused: FusedEstimate, limit: ElasticMotion) -> ElasticShare:
    """Return the share of the elastic motion that has been used since the object was unloaded; limit: all of it."""
    baselines, rotation_deg, shift_mm = memory.baselines, fused.rotation_deg, fused.shift_mm
    if limit.deg <= 0.0:
        return NO_SHARE
    parts: list[tuple[float, float]] = []
    if rotation_deg is not None and baselines.unloaded_deg is not None:
        parts.append(((rotation_deg - baselines.unloaded_deg) / limit.deg, (fused.rate_deg_s or 0.0) / limit.deg))
    if shift_mm is not None and baselines.unloaded_mm is not None:
        down_mm, side_mm = baselines.unloaded_mm
        parts.append(((shift_mm - down_mm) / limit.mm, memory.shift.rate_mm_s / limit.mm))
        parts.append((((fused.sideways_mm or 0.0) - side_mm) / limit.mm, memory.sideways.rate_mm_s / limit.mm))
    used = math.hypot(*(share for share, _ in parts))
    return ElasticShare(used, sum(share * rate for share, rate in parts) / used if used > 0.0 else 0.0)


@dataclass(frozen=True, slots=True)
class GrowingLoad:
    """A load that grows while the arm stands: where it began to.

    Args:
        began_s: when. used: the share then. from_deg, from_mm: rotation and shift then.
    """

    began_s: float
    used: float
    from_deg: float
    from_mm: float

    def soon(self, share: ElasticShare, ahead_s: float) -> float:
        """Return the share after this further time, with no more growth to come than has been seen."""
        return share.used + min(share.rate * ahead_s, share.used - self.used)


def growing_load(
    before: GrowingLoad | None, memory: SlipMemory, share: ElasticShare, rotation_deg: float, slip_mm: float
) -> GrowingLoad | None:
    """Return the load that grows now, with its beginning as before; None if none does.

    Args:
        memory: after this frame. rotation_deg, slip_mm: away from the episode's baseline.
    """
    if memory.arm.case is not ArmCase.REST or not memory.arm.hangs or share.rate <= GROWS_LEAST:
        return None
    return before or GrowingLoad(memory.captured_s, share.used, rotation_deg, slip_mm)
