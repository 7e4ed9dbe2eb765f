"""Anti-aliased contact shapes of known pose as probability maps, still or rotated frame by frame."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from slipguard.stress.map_checks import Map, check_sequence
from slipguard.stress.product_functions import MAP_HEIGHT_PX, MAP_WIDTH_PX, ProductFunctions, ScriptedPipeline
from slipguard.stress.trial_family import FamilyResults

Distance = Callable[[Map, Map], Map]
"""Signed distance to the contour in pixels, negative inside, at (u along the axis of the shape, v to its left)."""

SOFT_PX = 0.6
"""Width of the border: the network's output rises from 0.1 to 0.9 within about three pixels."""
ROUGH_SCALE_PX = 2.5
"""Correlation length of contour errors."""

_ROWS, _COLUMNS = np.mgrid[0:MAP_HEIGHT_PX, 0:MAP_WIDTH_PX].astype(np.float32)


@dataclass(frozen=True, slots=True)
class ShapePose:
    """Pose of a shape: mirrored first, then rotated counter-clockwise; center in map pixels right and down."""

    angle_deg: float = 0.0
    x_px: float = 59.5
    y_px: float = 79.5
    scale: float = 1.0
    mirrored: bool = False


def probability_map(shape: Distance, pose: ShapePose, rough: Map | None = None) -> Map:
    """Return the probability map of a shape, (160, 120) float32.

    rough: (160, 120) contour error in pixels, outward negative.
    """
    c = np.float32(math.cos(math.radians(pose.angle_deg)) / pose.scale)
    s = np.float32(math.sin(math.radians(pose.angle_deg)) / pose.scale)
    dx, dy = _COLUMNS - np.float32(pose.x_px), np.float32(pose.y_px) - _ROWS
    u, v = dx * c + dy * s, dy * c - dx * s
    outside = shape(u, -v if pose.mirrored else v) * np.float32(pose.scale)
    if rough is not None:
        outside = outside + rough
    return np.asarray(1.0 / (1.0 + np.exp(np.clip(outside / np.float32(SOFT_PX), -30, 30))), np.float32)


def roughness(rng: np.random.Generator, sigma_px: float) -> Map | None:
    """Return smooth random contour errors with this standard deviation, (160, 120); None for 0."""
    if sigma_px <= 0.0:
        return None
    field = rng.standard_normal((MAP_HEIGHT_PX, MAP_WIDTH_PX), dtype=np.float32)
    field = np.asarray(cv2.GaussianBlur(field, (0, 0), ROUGH_SCALE_PX), np.float32)
    return np.asarray(field * (sigma_px / field.std()), np.float32)


def box(half_long: float, half_wide: float) -> Distance:
    """Return a rectangle along u."""

    def distance(u: Map, v: Map) -> Map:
        x, y = np.abs(u) - np.float32(half_long), np.abs(v) - np.float32(half_wide)
        outer = np.hypot(np.maximum(x, 0), np.maximum(y, 0))
        return np.asarray(outer + np.minimum(np.maximum(x, y), 0), np.float32)

    return distance


def ellipse(half_long: float, half_wide: float) -> Distance:
    """Return an ellipse along u; the distance is exact to first order at its contour."""

    def distance(u: Map, v: Map) -> Map:
        k0 = np.hypot(u / np.float32(half_long), v / np.float32(half_wide))
        k1 = np.hypot(u / np.float32(half_long**2), v / np.float32(half_wide**2))
        return np.asarray(k0 * (k0 - 1) / np.maximum(k1, np.float32(1e-6)) - np.float32(half_wide) * (k1 == 0))

    return distance


def round_of(aspect: float) -> Distance:
    """Return an ellipse of this aspect ratio with the area of a disc of radius 26."""
    return ellipse(26.0 * math.sqrt(aspect), 26.0 / math.sqrt(aspect))


def polygon(corners: int, radius: float = 28.0) -> Distance:
    """Return a regular polygon."""
    half = math.pi / corners
    inner = np.float32(radius * math.cos(half))

    def distance(u: Map, v: Map) -> Map:
        around = np.arctan2(v, u)
        off = around - np.round(around / np.float32(2 * half)) * np.float32(2 * half)
        return np.asarray(np.hypot(u, v) * np.cos(off) - inner, np.float32)

    return distance


def ring(radius: float, half_wide: float) -> Distance:
    """Return a ring."""
    return lambda u, v: np.asarray(np.abs(np.hypot(u, v) - np.float32(radius)) - np.float32(half_wide), np.float32)


def _moved(shape: Distance, u0: float, v0: float) -> Distance:
    return lambda u, v: shape(u - np.float32(u0), v - np.float32(v0))


def _union(*shapes: Distance) -> Distance:
    return lambda u, v: np.asarray(np.minimum.reduce([shape(u, v) for shape in shapes]), np.float32)


def _wedge(u: Map, v: Map) -> Map:
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
"""Rotation from frame to frame of an object that falls."""


def check_rotating_shape(
    shape: Distance,
    start: ShapePose,
    end: ShapePose,
    product: ProductFunctions,
    results: FamilyResults,
    noise: tuple[Map | None, Map | None] = (None, None),
) -> float | None:
    """Rotate a shape frame by frame through the pipeline and check each estimate.

    Args:
        noise: Contour errors of the first frame, and of all later ones.

    Returns:
        The absolute error of the last estimate in degrees; None if it was declined.
    """
    rotation = end.angle_deg - start.angle_deg
    steps = max(1, math.ceil(abs(rotation) / STEP_DEG))

    def shown(step: int) -> tuple[Map, float]:
        part = step / steps
        pose = ShapePose(
            start.angle_deg + part * rotation,
            start.x_px + part * (end.x_px - start.x_px),
            start.y_px + part * (end.y_px - start.y_px),
            start.scale + part * (end.scale - start.scale),
            start.mirrored,
        )
        return probability_map(shape, pose, noise[0] if step == 0 else noise[1]), part * rotation

    return check_sequence(ScriptedPipeline(product), map(shown, range(steps + 1)), results)
