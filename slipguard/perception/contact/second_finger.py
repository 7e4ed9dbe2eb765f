"""When one finger's look may be left out because the other one sees better, and sees no change.

One object turns in both pictures at once. While the surer finger has just looked and found its picture unchanged, the
other adds nothing: its last answer stands, as old as it is, and is renewed every `refresh_s`, and with the next frame
after any change in the surer one. Where its last answer tells another turn than the surer one's, it is looked at each
time: one of the two is wrong, and the surer one may be the one that is stuck.
"""

from __future__ import annotations

import math
from dataclasses import replace

from slipguard.perception.estimate import Estimate
from slipguard.perception.pipeline import UNCHANGED

OTHER_FINGER = "other finger"
ABREAST_S = 0.05
"""The other finger's frame must not be further away in time than this: three frames at 60 fps."""

APART_SIGMAS, APART_DEG = 3.0, 1.0
"""Two fingers tell another turn where they are further apart than so many combined standard deviations, and this."""


def second_finger_can_skip(
    own: Estimate | None, other: Estimate | None, captured_at_s: float, refresh_s: float
) -> bool:
    """Whether a finger's frame of `captured_at_s` need not be looked at.

    own: its last answer. other: the other finger's. Never where own knows no reference, is surer than the other, tells
    another turn, or would be older than `refresh_s` at its next frame; nor where the other finger did not itself look
    and find nothing new.
    """
    if own is None or other is None or not (own.contact and other.contact):
        return False
    if other.skipped != UNCHANGED or other.sigma_deg is None or own.shift_mm is None:
        return False
    if own.sigma_deg is not None and own.sigma_deg < other.sigma_deg:
        return False
    if _apart(own, other):
        return False
    next_s = 2.0 * captured_at_s - own.captured_at_s
    young = own.measured_at_s <= captured_at_s and next_s - own.measured_at_s <= refresh_s
    return young and abs(captured_at_s - other.captured_at_s) <= ABREAST_S


def _apart(own: Estimate, other: Estimate) -> bool:
    """Whether the two tell another turn; one object turns the other way in the other picture."""
    if own.angle_deg is None or own.sigma_deg is None or other.angle_deg is None or other.sigma_deg is None:
        return False
    apart_deg = abs(own.angle_deg + other.angle_deg)
    return apart_deg > max(APART_DEG, APART_SIGMAS * math.hypot(own.sigma_deg, other.sigma_deg))


def repeat_estimate(own: Estimate, captured_at_s: float, sequence: int) -> Estimate:
    """The last answer for a frame that was not looked at; `measured_at_s` stays."""
    return replace(own, sequence=sequence, captured_at_s=captured_at_s, skipped=OTHER_FINGER, stage_ms={})
