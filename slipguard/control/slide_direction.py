"""Name the direction of a slide relative to gravity, from the orientation of the arm's tool.

Rotated by `mounting_deg`, an image shows the finger with its tip at the bottom. So down is the tool's z axis, which
points away from the flange along the fingers. To the right is across the fingers. How far that axis is from the
vertical depends on how the gripper is rotated on the flange, which is not known: across fingers that do not point up or
down, a slide has no known direction.

Only the report depends on it. A slide upwards is not the object's weight: the arm has pushed the object onto something.
It is answered like any other, for a sensor with a wrong `mounting_deg` must not hide that an object falls.
"""

from __future__ import annotations

import math

STEEP = math.cos(math.radians(45.0))
"""Fingers that point up or down within 45 degrees."""


def slide_direction(down_mm: float, right_mm: float, orientation_rad: tuple[float, float, float] | None) -> str:
    """Return the direction as text; empty if it is not known.

    Args:
        down_mm, right_mm: the slide in the left image.
        orientation_rad: of the tool, see `ArmState`.
    """
    if orientation_rad is None:
        return ""
    share = _down_share(orientation_rad)
    along = abs(down_mm) >= abs(right_mm)
    if abs(share) < STEEP:
        return "sideways" if along else ""
    if not along:
        return "sideways"
    return "downwards" if share * down_mm > 0.0 else "upwards, not by its weight"


def _down_share(orientation_rad: tuple[float, float, float]) -> float:
    """Return the cosine of the angle between the tool's z axis and the vertical downwards (Rodrigues' formula)."""
    angle_rad = math.hypot(*orientation_rad)
    if angle_rad == 0.0:
        return -1.0
    z_share = orientation_rad[2] / angle_rad
    return -(math.cos(angle_rad) + z_share**2 * (1.0 - math.cos(angle_rad)))
