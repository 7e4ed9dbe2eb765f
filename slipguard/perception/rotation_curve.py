"""The correlation of two textures over all rotations: which rotations a texture cannot tell apart, and where to search.

The curve of the reference with itself is known before anything moves. Its further maxima are the rotations after which
the texture looks the same or nearly so: periods (gears, nuts), symmetries (a bar by 180 degrees). The curve of a frame
is needed only after a gap in which the object may have rotated further than a registration searches.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.perception.texture_map import ImageWindow, TextureMap
from slipguard.perception.texture_template import TextureTemplate

STEP_DEG = 2.0
POINTS = 500
"""A curve has this step, and about this many points of the texture."""
SIMILAR = 0.5
"""Smallest correlation at a maximum of the curve that is followed up. Teeth and regular polygons reach 0.85-0.99, a nut
of which not all edges touch, a cross and four pins 0.75, other contacts of tools 0.6 and less."""
APART_DEG = 12.0
"""Registrations from starts that are closer together end at the same pose."""
SIMILAR_APART_DEG = 6.0
"""The finest period that is followed up: 60 teeth."""
STARTS_MAX = 4
"""A search begins at this many rotations."""

_ROTATIONS_DEG = np.arange(-180.0, 180.0, STEP_DEG)


def correlation_curve(
    template: TextureTemplate, texture_map: TextureMap, shift_px: tuple[float, float]
) -> NDArray[np.float32]:
    """Return the correlation of a texture with the template, rotated in steps of `STEP_DEG` from -180 degrees on.

    Args:
        template: The reference's texture.
        texture_map: The texture of a frame.
        shift_px: Where the reference's center is now, texture pixels right and down of where it was.
    """
    step = max(template.value.size // POINTS, 1)
    x, y, own = template.place[0, ::step], template.place[1, ::step], template.value[::step]
    window = texture_map.window
    center_x = np.float32(template.center_px[0] + shift_px[0] - window.left_px)
    center_y = np.float32(template.center_px[1] + shift_px[1] - window.top_px)
    c = np.cos(np.radians(_ROTATIONS_DEG)).astype(np.float32)[:, None]
    s = np.sin(np.radians(_ROTATIONS_DEG)).astype(np.float32)[:, None]
    place = c * x + s * y + center_x, c * y - s * x + center_y
    value = cv2.remap(texture_map.curvature, *place, cv2.INTER_LINEAR, borderValue=0.0)
    size = np.sqrt(np.einsum("ij,ij->i", value, value) * np.float32(own @ own))
    return np.asarray((value @ own) / np.maximum(size, np.float32(1e-9)), np.float32)


def maxima_deg(
    curve: NDArray[np.float32], near_deg: float, within_deg: float, apart_deg: float = APART_DEG
) -> list[float]:
    """Return the rotations at the maxima of a curve, the highest first, at least `apart_deg` apart.

    They are those nearest `near_deg`, and at most `within_deg` away from there.
    """
    peak = (curve >= np.roll(curve, 1)) & (curve > np.roll(curve, -1)) & (curve > SIMILAR)
    found: list[float] = []
    for k in sorted(np.flatnonzero(peak), key=lambda one: -curve[one]):
        rotation_deg = near_deg + math.remainder(float(_ROTATIONS_DEG[k]) - near_deg, 360.0)
        if abs(rotation_deg - near_deg) <= within_deg and all(abs(rotation_deg - one) >= apart_deg for one in found):
            found.append(rotation_deg)
    return found


def similar_deg(template: TextureTemplate) -> list[float]:
    """Return the rotations after which the reference's texture is similar to itself, without 0."""
    left, top = (round(at - inside) for at, inside in zip(template.center_px, template.origin_px, strict=True))
    own = TextureMap(ImageWindow(left, top, 0, 0), template.image)
    curve = correlation_curve(template, own, (0.0, 0.0))
    return [one for one in maxima_deg(curve, 0.0, 180.0, SIMILAR_APART_DEG) if one != 0.0]
