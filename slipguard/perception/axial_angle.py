"""Axial angles: directions without a head, equal modulo 180 degrees, and how to unwrap them."""

from __future__ import annotations

import math


def wrap_axial_deg(angle_deg: float) -> float:
    """Return the same axis in (-90, 90]: axes have no head, they are equal modulo 180 degrees."""
    wrapped = math.fmod(angle_deg, 180.0)
    if wrapped > 90.0:
        return wrapped - 180.0
    return wrapped + 180.0 if wrapped <= -90.0 else wrapped


def axial_difference_deg(now_deg: float, before_deg: float) -> float:
    """Return the smallest rotation from axis `before_deg` to axis `now_deg`, in (-90, 90]."""
    return wrap_axial_deg(now_deg - before_deg)


def nearest_rotation_deg(axial_deg: float, near_deg: float) -> float:
    """Unwrap an axis: return the rotation nearest `near_deg` of those that differ from `axial_deg` by 180 degrees."""
    return near_deg + wrap_axial_deg(axial_deg - near_deg)
