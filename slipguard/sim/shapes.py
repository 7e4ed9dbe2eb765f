"""Building blocks of height maps: signed distances of contours, faces over them, and textures.

Lengths in mm. A distance is negative inside its contour; a height is 0 at the top and negative below.
Every function takes and returns float32 arrays of one shape.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import reduce
from itertools import pairwise

import numpy as np

from slipguard.sim.raster import Field, f32

Point = tuple[float, float]
_WALL = 8.0
"""Slope of a face's flank, mm per mm: finite, so that it can be sampled."""


def rotated(u: Field, v: Field, angle_deg: float, about: Point = (0.0, 0.0)) -> tuple[Field, Field]:
    """Return the coordinates in a frame at `about`, rotated counter-clockwise by `angle_deg`."""
    c, s = np.float32(math.cos(math.radians(angle_deg))), np.float32(math.sin(math.radians(angle_deg)))
    du, dv = u - np.float32(about[0]), v - np.float32(about[1])
    return c * du + s * dv, c * dv - s * du


# Contours.


def disc(u: Field, v: Field, radius: float, at: Point = (0.0, 0.0)) -> Field:
    return f32(np.hypot(u - np.float32(at[0]), v - np.float32(at[1])) - np.float32(radius))


def box(u: Field, v: Field, half_u: float, half_v: float, at: Point = (0.0, 0.0), corner: float = 0.0) -> Field:
    x = np.abs(u - np.float32(at[0])) - np.float32(half_u - corner)
    y = np.abs(v - np.float32(at[1])) - np.float32(half_v - corner)
    outside = np.hypot(np.maximum(x, 0), np.maximum(y, 0))
    return f32(outside + np.minimum(np.maximum(x, y), 0) - np.float32(corner))


def path(u: Field, v: Field, points: Sequence[Point], half_width: float) -> Field:
    """Return the distance to a band along the line through `points`, with round ends."""
    nearest = reduce(np.minimum, (_segment(u, v, a, b) for a, b in pairwise(points)))
    return nearest - np.float32(half_width)


def arc(radius: float, start_deg: float, stop_deg: float, at: Point = (0.0, 0.0), count: int = 13) -> list[Point]:
    """Return points along a circle, for `path` and `polygon`."""
    angles = np.radians(np.linspace(start_deg, stop_deg, count))
    return [(at[0] + radius * math.cos(a), at[1] + radius * math.sin(a)) for a in angles]


def polygon(u: Field, v: Field, points: Sequence[Point]) -> Field:
    """Return the distance to a simple polygon, in either orientation."""
    ring = [*points, points[0]]
    distance = path(u, v, ring, 0.0)
    inside = np.zeros(u.shape, np.bool_)
    for (x0, y0), (x1, y1) in pairwise(ring):
        if y0 == y1:
            continue
        crosses = (v >= min(y0, y1)) & (v < max(y0, y1))
        inside ^= crosses & (u < np.float32(x0) + (v - np.float32(y0)) * np.float32((x1 - x0) / (y1 - y0)))
    return np.where(inside, -distance, distance)


def regular(u: Field, v: Field, sides: int, radius: float) -> Field:
    """Return the distance to a regular polygon of a circumscribed radius; one corner points along +u."""
    return polygon(u, v, arc(radius, 0.0, 360.0 * (1 - 1 / sides), count=sides))


def union(*distances: Field) -> Field:
    return reduce(np.minimum, distances)


def without(distance: Field, *holes: Field) -> Field:
    return reduce(np.maximum, [-hole for hole in holes], distance)


def inside(distance: Field, soft: float) -> Field:
    """Return 1 inside a contour, 0 outside, with a ramp of width `soft` inside its border."""
    return f32(np.clip(-distance / np.float32(soft), 0.0, 1.0))


# Faces.


def plateau(distance: Field, edge: float) -> Field:
    """Return a flat face over a contour, its rim rounded with radius `edge`."""
    into_rim = np.clip(distance + np.float32(edge), 0.0, edge)
    rounded = np.sqrt(np.maximum(np.float32(edge * edge) - into_rim * into_rim, 0.0)) - np.float32(edge)
    return f32(rounded - np.float32(_WALL) * np.maximum(distance, 0.0))


def cylinder(across: Field, radius: float) -> Field:
    """Return the side of a cylinder; `across` is the distance from its ridge."""
    return _round(np.abs(across), radius)


def sphere(u: Field, v: Field, radius: float, at: Point = (0.0, 0.0)) -> Field:
    """Return the top of a ball."""
    return _round(np.hypot(u - np.float32(at[0]), v - np.float32(at[1])), radius)


def ridge(across: Field, slope: float, tip: float = 0.1) -> Field:
    """Return a roof that falls with `slope` to both sides; its edge is rounded with radius `tip`."""
    rounding = np.float32(tip * slope)
    return f32(rounding - np.sqrt(rounding * rounding + np.float32(slope * slope) * across * across))


def highest(*heights: Field) -> Field:
    return reduce(np.maximum, heights)


def lowered(height: Field, distance: Field) -> Field:
    """Return a surface that ends at a contour, with steep flanks outside."""
    return f32(height - np.float32(_WALL) * np.maximum(distance, 0.0))


# Textures: depths >= 0, to subtract from a height.


def grooves(along: Field, period: float, depth: float) -> Field:
    """Return parallel grooves with a cosine profile."""
    return f32(np.float32(depth / 2) * (1 - np.cos(along * np.float32(2 * math.pi / period))))


def knurl(u: Field, v: Field, period: float, depth: float) -> Field:
    """Return crossed grooves at +-45 degrees: small pyramids."""
    a, b = (u + v) * np.float32(math.sqrt(0.5)), (u - v) * np.float32(math.sqrt(0.5))
    return np.maximum(grooves(a, period, depth), grooves(b, period, depth))


def dimples(u: Field, v: Field, period: float, radius: float, depth: float) -> Field:
    """Return round hollows on a triangular lattice, the origin in the middle between three of them."""
    rise = period * math.sqrt(3.0)
    nearest = np.full(u.shape, period, np.float32)
    for start in ((0.0, 2.0 * rise / 6.0), (period / 2, 5.0 * rise / 6.0)):  # the lattice is two rectangular ones
        du = (u - np.float32(start[0]) + np.float32(period / 2)) % np.float32(period) - np.float32(period / 2)
        dv = (v - np.float32(start[1]) + np.float32(rise / 2)) % np.float32(rise) - np.float32(rise / 2)
        nearest = np.minimum(nearest, np.hypot(du, dv))
    return f32(np.float32(depth) * np.maximum(1 - (nearest / np.float32(radius)) ** 2, 0))


def rays(u: Field, v: Field, count: int, depth: float, inner: float) -> Field:
    """Return radial grooves, from radius `inner` on."""
    shown = np.clip((np.hypot(u, v) - np.float32(inner)) * 4, 0, 1)
    return np.float32(depth / 2) * (1 - np.cos(np.arctan2(v, u) * np.float32(count))) * shown


def _round(distance: Field, radius: float) -> Field:
    inside = np.minimum(distance, np.float32(0.98 * radius))
    fall = np.sqrt(np.float32(radius * radius) - inside * inside) - np.float32(radius)
    return fall - np.float32(_WALL) * (distance - inside)


def _segment(u: Field, v: Field, a: Point, b: Point) -> Field:
    du, dv = b[0] - a[0], b[1] - a[1]
    squared = du * du + dv * dv
    pu, pv = u - np.float32(a[0]), v - np.float32(a[1])
    if squared == 0.0:
        return f32(np.hypot(pu, pv))
    t = np.clip((pu * np.float32(du) + pv * np.float32(dv)) / np.float32(squared), 0.0, 1.0)
    return np.hypot(pu - t * np.float32(du), pv - t * np.float32(dv))
