"""Axial angles: directions without a head, equal modulo half a turn, and how to average and unwrap them."""

from __future__ import annotations

import math
from collections.abc import Iterable


def wrap_axial_deg(angle_deg: float) -> float:
    """The same axis in (-90, 90]."""
    wrapped = math.fmod(angle_deg, 180.0)
    if wrapped > 90.0:
        return wrapped - 180.0
    return wrapped + 180.0 if wrapped <= -90.0 else wrapped


def axial_difference_deg(now_deg: float, before_deg: float) -> float:
    """The smallest turn that brings axis `before_deg` onto axis `now_deg`, in (-90, 90]."""
    return wrap_axial_deg(now_deg - before_deg)


def nearest_rotation_deg(axial_deg: float, near_deg: float) -> float:
    """Of the turns that differ from `axial_deg` by half turns the one nearest `near_deg`: unwraps an axis."""
    return near_deg + wrap_axial_deg(axial_deg - near_deg)


def axial_mean_deg(angles_deg: Iterable[float], weights: Iterable[float]) -> float:
    """Weighted mean of axes, by doubled angles, in (-90, 90]."""
    x = y = 0.0
    for angle, weight in zip(angles_deg, weights, strict=True):
        doubled = math.radians(2.0 * angle)
        x += weight * math.cos(doubled)
        y += weight * math.sin(doubled)
    return wrap_axial_deg(math.degrees(math.atan2(y, x)) / 2.0)
