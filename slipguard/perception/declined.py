"""Reasons why a frame gives no rotation, and how a reason is worded.

`Estimate.declined` starts with one of these reasons. Details follow after a colon: the measured value, the limit, and
what to do. Match on `Estimate.decline_reason`, never on the whole text: the value changes from frame to frame.
"""

from __future__ import annotations

from enum import StrEnum


class DeclineReason(StrEnum):
    """Why there is no rotation, or no shift."""

    NO_CONTACT = "no contact"
    NO_REFERENCE = "no reference yet"
    NO_BACKGROUND = "no background image"
    CHECKING_STORED_REFERENCE = "checking the stored reference"
    CONTACT_TOO_SMALL = "contact too small"
    CONTACT_CHANGED = "contact changed too much since the reference"
    ROUND = "round contact"
    CLIPPED = "clipped by the frame"
    NO_MIDDLE_LINE = "no straight middle line"
    UNCERTAIN = "too uncertain"
    JUMP = "implausible jump"
    SEVERAL_ROTATIONS = "texture fits at several rotations"
    SHIFT_AMBIGUOUS = "periodic texture, shift ambiguous"
    GEL_MEMORY = "gel shows an earlier imprint"
    NOT_A_NUMBER = "not a number"
    IMAGE = "image unusable"


def explain(reason: DeclineReason, detail: str) -> str:
    """Return a reason with the value, the limit and what to do, as in "round contact: aspect 1.08, limit 1.15"."""
    return f"{reason.value}: {detail}"
