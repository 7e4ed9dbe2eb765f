"""Decides whether a contact is too round to measure its rotation by its axis, its contour or its texture.

Each of the three ways has its own test. A test returns the decline reason with value and limit if the contact is too
round for that way, and None if it is not. `fusion.py` declines the rotation if none of the three ways remains.
"""

from __future__ import annotations

from slipguard.perception.declined import DeclineReason, explain

MOTION_MIN_PX = 2.2
"""A rotation by one radian must move the contour by at least this (r.m.s., beyond what shift and growth explain)."""
CONTRAST_MIN = 0.10
"""A rotation by `contour_template.CONTRAST_DEG` must change the blurred contour by this (r.m.s. of probability)."""
TEXTURE_CHANGE_MIN = 1.3
"""Change of the blurred texture by a rotation of one radian (beyond what shift, scale and gain explain) over the
texture itself, r.m.s.: 0.3-1.0 for plain balls and rings, rendered and real, 1.4 and more for contacts with a face."""
FAINT_SHARE = 0.25
"""A faint texture must change more, since noise also has an axis: by this share at `FAINT_LEVELS`, and with the inverse
square of the strength. Real faint balls reach a change of 1.3."""
FAINT_LEVELS = 1.2
"""Strength of a faint texture, gray levels per pixel, r.m.s."""


def round_axis_reason(aspect: float, aspect_min: float) -> str | None:
    """Return why a patch is too round to have an axis; None if it is not. aspect: long over short axis."""
    if aspect >= aspect_min:
        return None
    return explain(DeclineReason.ROUND, f"aspect {aspect:.2f}, limit {aspect_min:.2f}")


def round_contour_reason(motion_px: float, contrast: float) -> str | None:
    """Return why a contour is too round to show a rotation; None if it is not.

    Args:
        motion_px: How far a rotation by one radian moves the contour, network pixels.
        contrast: Change of the blurred contour by a fixed rotation, r.m.s. of probability.
    """
    if motion_px < MOTION_MIN_PX:
        return explain(DeclineReason.ROUND, f"contour moves {motion_px:.1f} px per radian, limit {MOTION_MIN_PX}")
    if contrast < CONTRAST_MIN:
        return explain(DeclineReason.ROUND, f"contour changes by {contrast:.2f} when rotated, limit {CONTRAST_MIN:.2f}")
    return None


def round_texture_reason(change: float, strength_levels: float) -> str | None:
    """Return why a texture changes too little when rotated, as that of a ball; None if it changes enough.

    Args:
        change: Change of the texture by a rotation of one radian over the texture itself.
        strength_levels: R.m.s. of the texture, gray levels per pixel.
    """
    limit = TEXTURE_CHANGE_MIN * (1.0 + FAINT_SHARE * (FAINT_LEVELS / max(strength_levels, 1e-3)) ** 2)
    if not change < limit:
        return None
    return explain(DeclineReason.ROUND, f"texture changes by {change:.2f} per radian, limit {limit:.2f}")
