"""When one finger's look may be left out because the other one sees better, and sees no change.

One object turns in both pictures at once. While the surer finger has just looked and found its picture unchanged, the
other adds nothing: its last answer stands, as old as it is, and is renewed every `refresh_s`, and with the next frame
after any change in the surer one.
"""

from __future__ import annotations

from dataclasses import replace

from slipguard.perception.estimate import Estimate
from slipguard.perception.pipeline import UNCHANGED

OTHER_FINGER = "other finger"
ABREAST_S = 0.05
"""The other finger's frame must not be further away in time than this: three frames at 60 fps."""


def adds_nothing(own: Estimate | None, other: Estimate | None, captured_at_s: float, refresh_s: float) -> bool:
    """Whether a finger's frame of `captured_at_s` need not be looked at.

    own: its last answer. other: the other finger's. Never where own knows no reference, is surer than the other, or was
    measured `refresh_s` ago; nor where the other finger did not itself look and find nothing new.
    """
    if own is None or other is None or not (own.contact and other.contact):
        return False
    if other.skipped != UNCHANGED or other.sigma_deg is None or own.shift_mm is None:
        return False
    if own.sigma_deg is not None and own.sigma_deg < other.sigma_deg:
        return False
    young = 0.0 <= captured_at_s - own.measured_at_s < refresh_s
    return young and abs(captured_at_s - other.captured_at_s) <= ABREAST_S


def again(own: Estimate, captured_at_s: float, sequence: int) -> Estimate:
    """The last answer for a frame that was not looked at; `measured_at_s` stays."""
    return replace(own, sequence=sequence, captured_at_s=captured_at_s, skipped=OTHER_FINGER, stage_ms={})
