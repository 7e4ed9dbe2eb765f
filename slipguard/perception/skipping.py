"""Which frames need not be measured: the switches for skipping, and the rule for skipping the second finger.

One object rotates in both images at once. If the finger with the smaller sigma has just found its image unchanged,
the other finger's last estimate is repeated. It is renewed every `refresh_s`, and with the next frame after any change
in the first finger's image. If the two fingers report different rotations, one is wrong: then both are measured.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from slipguard.perception.estimate import Estimate

UNCHANGED = "unchanged"
OTHER_FINGER = "other finger"
MAX_FRAME_GAP_S = 0.05
"""Largest time between the frames of the two fingers: three frames at 60 Hz."""
DISAGREE_SIGMAS, DISAGREE_DEG = 3.0, 1.0
"""Two fingers disagree if their rotations differ by more than both: combined standard deviations, degrees."""


@dataclass(frozen=True, slots=True)
class Skips:
    """Which stages may be skipped; switched off only to measure what each saves.

    no_contact: the network, without contact. unchanged: everything, on an unchanged image.
    whole: the network, while the texture shows that the contact moves as a whole.
    """

    no_contact: bool = True
    unchanged: bool = True
    whole: bool = True


ALL_SKIPS = Skips()


def second_finger_can_skip(
    own: Estimate | None, other: Estimate | None, captured_at_s: float, refresh_s: float
) -> bool:
    """Return whether a finger's frame of `captured_at_s` need not be measured.

    Args:
        own: The finger's last estimate.
        other: The other finger's last estimate.
        captured_at_s: Capture time of the frame.
        refresh_s: Longest age of a repeated estimate at the next frame.

    Returns:
        False if `own` has no reference or the smaller sigma, if the fingers disagree, if the estimate would be too
        old, or if the other finger did not itself measure an unchanged image.
    """
    if own is None or other is None or not (own.contact and other.contact):
        return False
    if other.skipped != UNCHANGED or other.sigma_deg is None or not own.has_reference:
        return False
    if own.sigma_deg is not None and own.sigma_deg < other.sigma_deg:
        return False
    if _disagree(own, other):
        return False
    next_s = 2.0 * captured_at_s - own.captured_at_s
    recent = own.measured_at_s <= captured_at_s and next_s - own.measured_at_s <= refresh_s
    return recent and abs(captured_at_s - other.captured_at_s) <= MAX_FRAME_GAP_S


def repeat_estimate(own: Estimate, captured_at_s: float, sequence: int) -> Estimate:
    """Return the last estimate for a skipped frame; `measured_at_s` stays."""
    return replace(own, sequence=sequence, captured_at_s=captured_at_s, skipped=OTHER_FINGER, stage_ms={})


def _disagree(own: Estimate, other: Estimate) -> bool:
    """Return whether the fingers report different rotations; the two images see one rotation with opposite signs."""
    if own.rotation_deg is None or own.sigma_deg is None or other.rotation_deg is None or other.sigma_deg is None:
        return False
    apart_deg = abs(own.rotation_deg + other.rotation_deg)
    return apart_deg > max(DISAGREE_DEG, DISAGREE_SIGMAS * math.hypot(own.sigma_deg, other.sigma_deg))
