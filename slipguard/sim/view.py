"""What one fingertip camera has before it at one instant: the link between mechanics and renderer."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class GelView:
    """Pose of the object's imprint in one finger's picture. Picklable, a few numbers.

    x_mm, y_mm: object origin (the grasp axis) from the picture's centre, right and up.
    angle_deg: object angle, counter-clockwise as a viewer sees the picture.
    depth_mm: how deep the object's highest point would overlap the undeformed gel; <= 0 is no contact.
    vx_mm_s, vy_mm_s, rate_deg_s: motion in the picture, for smear during the exposure.
    """

    object_name: str
    x_mm: float = 0.0
    y_mm: float = 0.0
    angle_deg: float = 0.0
    depth_mm: float = 0.0
    vx_mm_s: float = 0.0
    vy_mm_s: float = 0.0
    rate_deg_s: float = 0.0
