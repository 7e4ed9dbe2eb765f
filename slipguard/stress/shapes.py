"""Anti-aliased contact shapes of known pose as probability maps, read as still maps or rotated frame by frame."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.perception.estimate import AxisEstimate
from slipguard.stress.map_checks import Map, patch_of, read
from slipguard.stress.product_functions import MAP_HEIGHT_PX, MAP_PX, MAP_WIDTH_PX, ProductFunctions, ScriptedPipeline
from slipguard.stress.trial_family import FamilyResults

Plane = NDArray[np.float32]
Distance = Callable[[Plane, Plane], Plane]
"""Pixels outside the outline (negative inside) at points (u along the shape's own axis, v to its left)."""

SOFT_PX = 0.6
"""Softness of a border: the network's own goes from 0.1 to 0.9 within about three pixels."""
ROUGH_SCALE_PX = 2.5
"""Errors of the outline are alike over about this far."""

_ROWS, _COLUMNS = np.mgrid[0:MAP_HEIGHT_PX, 0:MAP_WIDTH_PX].astype(np.float32)


@dataclass(frozen=True, slots=True)
class ShapePose:
    """Where a shape lies: turned counter-clockwise as seen, centre in map pixels right and down, mirrored first."""

    angle_deg: float = 0.0
    x_px: float = 59.5
    y_px: float = 79.5
    scale: float = 1.0
    mirrored: bool = False


def soft(shape: Distance, pose: ShapePose, rough: Plane | None = None) -> Plane:
    """Probability (160, 120) float32. rough: (160, 120), how far the outline is off, pixels, outward negative."""
    c = np.float32(math.cos(math.radians(pose.angle_deg)) / pose.scale)
    s = np.float32(math.sin(math.radians(pose.angle_deg)) / pose.scale)
    dx, dy = _COLUMNS - np.float32(pose.x_px), np.float32(pose.y_px) - _ROWS
    u, v = dx * c + dy * s, dy * c - dx * s
    outside = shape(u, -v if pose.mirrored else v) * np.float32(pose.scale)
    if rough is not None:
        outside = outside + rough
    return np.asarray(1.0 / (1.0 + np.exp(np.clip(outside / np.float32(SOFT_PX), -30, 30))), np.float32)


def roughness(rng: np.random.Generator, sigma_px: float) -> Plane | None:
    """Smooth random errors of the outline with this standard deviation; None for 0."""
    if sigma_px <= 0.0:
        return None
    field = rng.standard_normal((MAP_HEIGHT_PX, MAP_WIDTH_PX), dtype=np.float32)
    field = np.asarray(cv2.GaussianBlur(field, (0, 0), ROUGH_SCALE_PX), np.float32)
    return np.asarray(field * (sigma_px / field.std()), np.float32)


def box(half_long: float, half_wide: float) -> Distance:
    """A rectangle along u."""

    def distance(u: Plane, v: Plane) -> Plane:
        x, y = np.abs(u) - np.float32(half_long), np.abs(v) - np.float32(half_wide)
        outer = np.hypot(np.maximum(x, 0), np.maximum(y, 0))
        return np.asarray(outer + np.minimum(np.maximum(x, y), 0), np.float32)

    return distance


def ellipse(half_long: float, half_wide: float) -> Distance:
    """An ellipse along u; the distance is exact to first order at its outline."""

    def distance(u: Plane, v: Plane) -> Plane:
        k0 = np.hypot(u / np.float32(half_long), v / np.float32(half_wide))
        k1 = np.hypot(u / np.float32(half_long**2), v / np.float32(half_wide**2))
        return np.asarray(k0 * (k0 - 1) / np.maximum(k1, np.float32(1e-6)) - np.float32(half_wide) * (k1 == 0))

    return distance


def round_of(aspect: float, radius: float = 26.0) -> Distance:
    """An ellipse of this aspect with the area of a disc."""
    return ellipse(radius * math.sqrt(aspect), radius / math.sqrt(aspect))


def polygon(corners: int, radius: float = 28.0) -> Distance:
    """A regular polygon."""
    half = math.pi / corners
    inner = np.float32(radius * math.cos(half))

    def distance(u: Plane, v: Plane) -> Plane:
        around = np.arctan2(v, u)
        off = around - np.round(around / np.float32(2 * half)) * np.float32(2 * half)
        return np.asarray(np.hypot(u, v) * np.cos(off) - inner, np.float32)

    return distance


def ring(radius: float, half_wide: float) -> Distance:
    return lambda u, v: np.asarray(np.abs(np.hypot(u, v) - np.float32(radius)) - np.float32(half_wide), np.float32)


def _moved(shape: Distance, u0: float, v0: float) -> Distance:
    return lambda u, v: shape(u - np.float32(u0), v - np.float32(v0))


def _union(*shapes: Distance) -> Distance:
    return lambda u, v: np.asarray(np.minimum.reduce([shape(u, v) for shape in shapes]), np.float32)


def _wedge(u: Plane, v: Plane) -> Plane:
    return np.asarray(np.maximum(np.abs(v) - (np.float32(0.22) * u + 12), np.abs(u) - 36), np.float32)


ALONG_U: dict[str, Distance] = {
    "bar": box(34, 9),
    "thin bar": box(40, 3.5),
    "rectangle": box(28, 19),
    "ellipse": ellipse(36, 19),
    "slim ellipse": ellipse(38, 8),
    "wedge": _wedge,
    "key": _union(_moved(ellipse(13, 13), -22, 0), _moved(box(26, 5), 13, 0)),
    "dumbbell": _union(_moved(ellipse(12, 12), -24, 0), _moved(ellipse(12, 12), 24, 0), box(24, 4)),
    "two bars": _union(_moved(box(30, 5), 0, 11), _moved(box(30, 5), 0, -11)),
}
"""Shapes whose axis is u by symmetry."""
ELONGATED: dict[str, Distance] = {
    **ALONG_U,
    "hook": _union(box(32, 7), _moved(box(7, 14), 25, 14)),
    "tee": _union(_moved(box(32, 6), 0, 6), _moved(box(6, 14), 4, -8)),
    "bolt": _union(_moved(box(9, 15), -24, 2), _moved(box(26, 7), 8, 0)),
}
"""Shapes with a readable axis, not all of them mirror images of themselves."""
LONG_BAR = box(200, 11)
DISC = ellipse(26, 26)


STEP_DEG = 5.0
"""A fall turns an object by this much from frame to frame."""


def readings_of(
    maps: tuple[Map, Map], product: ProductFunctions, results: FamilyResults
) -> list[dict[str, AxisEstimate]] | None:
    patches = [patch_of(one, 100.0, MAP_PX, product, results) for one in maps]
    return [read(one, product, results) for one in patches if one is not None] if None not in patches else None


def rotation_held(
    shape: Distance,
    start: ShapePose,
    end: ShapePose,
    product: ProductFunctions,
    results: FamilyResults,
    noise: tuple[Map | None, Map | None],
) -> float | None:
    """Turn a shape frame by frame through the pipeline; the last answer's error, None where it declined.

    noise: roughness of the reference and of the last frame; those between carry the last one's.
    """
    finger = ScriptedPipeline(product)
    rotation = end.angle_deg - start.angle_deg
    steps = max(1, math.ceil(abs(rotation) / STEP_DEG))
    error = None
    for k in range(steps + 1):
        part = k / steps
        pose = ShapePose(
            start.angle_deg + part * rotation,
            start.x_px + part * (end.x_px - start.x_px),
            start.y_px + part * (end.y_px - start.y_px),
            start.scale + part * (end.scale - start.scale),
            start.mirrored,
        )
        answer = results.call("pipeline", finger.see, soft(shape, pose, noise[0] if k == 0 else noise[1]))
        if answer is None:
            return None
        results.check_finite("pipeline", answer.orientation_deg, answer.rate_deg_s, *(answer.shift_mm or ()))
        error = results.check_angle("pipeline", answer.angle_deg, answer.sigma_deg, part * rotation, axial=False)
    return error
