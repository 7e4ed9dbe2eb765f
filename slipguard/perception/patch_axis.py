"""Fits an axis to a contact patch: second moments, an ellipse through the contour, a line through the skeleton."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.perception.axial_angle import axial_difference_deg, wrap_axial_deg
from slipguard.perception.declined import DeclineReason, explain
from slipguard.perception.patch import Patch
from slipguard.perception.skeleton import MiddleLine

EVEN_SHARE = 0.1
"""Largest difference, as a share, between the halves of a patch on even and odd rows and columns."""
LARGE_PX = 4000
"""A crop with more network pixels is large."""
SMALLEST_PX = 40
"""Smallest patch with an axis, network pixels."""
LINE_SHARE_MIN = 0.3
"""If most of the skeleton is corner branches its middle line is no axis."""

Weights = NDArray[np.float32] | NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class PatchAxis:
    """An axis in crop coordinates. long_px, short_px: semi-axes of the ellipse with the same second moments.

    rough_px: residual of the fit, if it affects the accuracy of the axis.
    """

    angle_deg: float
    x_px: float
    y_px: float
    long_px: float
    short_px: float
    rough_px: float = 0.0

    @property
    def aspect(self) -> float:
        return self.long_px / max(self.short_px, 1e-6)

    def sigma_deg(self, contour_px: float) -> float:
        """Return how far the axis rotates if the contour is wrong by `contour_px`.

        An ellipse that rotates by a radian moves its contour by (a^2 - b^2) / (2 sqrt(a^2 + b^2)) on average (r.m.s.).
        """
        a2, b2 = self.long_px**2, self.short_px**2
        motion_px = (a2 - b2) / (2.0 * math.sqrt(a2 + b2) + 1e-9)
        return math.degrees(contour_px / max(motion_px, 1e-3))


def _too_small(patch: Patch) -> str:
    detail = f"{np.count_nonzero(patch.mask)} network pixels, minimum {SMALLEST_PX}"
    return explain(DeclineReason.CONTACT_TOO_SMALL, detail)


def cut_share(patch: Patch) -> float:
    """Return the share of the patch's outer contour that is the frame's edge; of a cut ring the whole chord counts."""
    contours, _ = cv2.findContours(patch.mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    around = cv2.arcLength(cv2.convexHull(np.concatenate(contours)), True)
    cuts = (np.flatnonzero(side) for side in _sides(patch) if side is not None)
    spans = [int(cut[-1]) - int(cut[0]) + 1 for cut in cuts if cut.size]
    return min(sum(spans) / max(around, 1.0), 1.0)


def _sides(patch: Patch) -> tuple[NDArray[np.uint8] | None, ...]:
    """Return the mask along the left, right, top and bottom of its crop; None for sides that the frame does not cut."""
    mask, sides = patch.mask, patch.clipped
    return (
        mask[:, 0] if sides.left else None,
        mask[:, -1] if sides.right else None,
        mask[0] if sides.top else None,
        mask[-1] if sides.bottom else None,
    )


def _axis_of_moments(mean_x: float, mean_y: float, xx: float, yy: float, xy: float) -> PatchAxis:
    """Return the axis with these second central moments, y downwards."""
    middle, half = (xx + yy) / 2.0, math.hypot((xx - yy) / 2.0, xy)
    angle = wrap_axial_deg(-math.degrees(math.atan2(2.0 * xy, xx - yy)) / 2.0)
    return PatchAxis(
        angle, mean_x, mean_y, 2.0 * math.sqrt(max(middle + half, 0.0)), 2.0 * math.sqrt(max(middle - half, 0.0))
    )


def _axis_of_image(weights: Weights, binary: bool) -> PatchAxis | None:
    m = cv2.moments(weights, binary)
    mass = m["m00"]
    if mass < SMALLEST_PX:
        return None
    return _axis_of_moments(m["m10"] / mass, m["m01"] / mass, m["mu20"] / mass, m["mu02"] / mass, m["mu11"] / mass)


def _moments_axis(patch: Patch) -> tuple[PatchAxis | None, str | None]:
    return _square_cut(patch, patch.probability, binary=False)


def _pca_axis(patch: Patch) -> tuple[PatchAxis | None, str | None]:
    return _square_cut(patch, patch.mask, binary=True)


def _square_cut(patch: Patch, weights: Weights, binary: bool) -> tuple[PatchAxis | None, str | None]:
    """Return the axis by second moments. An end that the frame cuts obliquely is first cut square: no bias for bars."""
    axis = _axis_of_image(weights, binary)
    if axis is None:
        return None, _too_small(patch)
    if not patch.clipped.any:
        return axis, None
    step = coarse_step(weights)  # the ends stay sharp enough
    coarse = np.ascontiguousarray(weights[::step, ::step])
    edge_x, edge_y = _edge_points(patch)
    across, down = edge_x - np.float32(axis.x_px), edge_y - np.float32(axis.y_px)
    rows, columns = coarse.shape
    x = step * np.arange(columns, dtype=np.float32)[None, :] - np.float32(axis.x_px)
    y = step * np.arange(rows, dtype=np.float32)[:, None] - np.float32(axis.y_px)
    uncut = axis
    for _ in range(3):
        c, s = math.cos(math.radians(axis.angle_deg)), -math.sin(math.radians(axis.angle_deg))
        along = across * np.float32(c) + down * np.float32(s)
        after, before = along[along > 0], along[along <= 0]
        furthest = float(after.min()) if after.size else math.inf
        nearest = float(before.max()) if before.size else -math.inf
        u = x * np.float32(c) + y * np.float32(s)
        cut = _axis_of_image(np.where((u < furthest) & (u > nearest), coarse, coarse.dtype.type(0)), binary)
        if cut is None or abs(axial_difference_deg(cut.angle_deg, uncut.angle_deg)) > 30.0:
            return uncut, DeclineReason.CLIPPED
        settled = abs(axial_difference_deg(cut.angle_deg, axis.angle_deg)) < 0.1
        axis = PatchAxis(cut.angle_deg, step * cut.x_px, step * cut.y_px, step * cut.long_px, step * cut.short_px)
        if settled:
            break
    return axis, None


def coarse_step(weights: Weights) -> int:
    """Return 2 if a patch is so large that every other row and column is enough, else 1.

    Of thin lines some would be missed: then the sums over the four halves of rows and columns differ.
    """
    if weights.size <= LARGE_PX:
        return 1
    quarters = [float(weights[row::2, column::2].sum()) for row in (0, 1) for column in (0, 1)]
    return 2 if max(quarters) - min(quarters) <= EVEN_SHARE * max(quarters) else 1


def _edge_points(patch: Patch) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the patch pixels on the frame's sides, crop coordinates; a pixel in a corner may come twice."""
    left, right, top, bottom = (None if side is None else np.flatnonzero(side) for side in _sides(patch))
    rows, columns = patch.mask.shape
    x: list[NDArray[np.intp]] = []
    y: list[NDArray[np.intp]] = []
    for side, column in ((left, 0), (right, columns - 1)):
        if side is not None:
            x.append(np.full(side.size, column))
            y.append(side)
    for side, row in ((top, 0), (bottom, rows - 1)):
        if side is not None:
            x.append(side)
            y.append(np.full(side.size, row))
    return np.concatenate(x).astype(np.float32), np.concatenate(y).astype(np.float32)


def _ellipse_axis(patch: Patch) -> tuple[PatchAxis | None, str | None]:
    """Fit an ellipse to the contour, without the points on the frame's edge."""
    contours, _ = cv2.findContours(patch.mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    if not contours or np.count_nonzero(patch.mask) < SMALLEST_PX:
        return None, _too_small(patch)
    points = np.concatenate(contours)[:, 0]
    sides = patch.clipped
    if sides.any:
        rows, columns = patch.mask.shape
        total = len(points)
        keep = np.ones(total, np.bool_)
        if sides.left:
            keep &= points[:, 0] > 0
        if sides.right:
            keep &= points[:, 0] < columns - 1
        if sides.top:
            keep &= points[:, 1] > 0
        if sides.bottom:
            keep &= points[:, 1] < rows - 1
        points = points[keep]
        if len(points) < max(12, 0.4 * total):
            return None, DeclineReason.CLIPPED
    if len(points) < 12:
        return None, _too_small(patch)
    (x, y), (first, second), rotated = cv2.fitEllipseDirect(points.astype(np.float32))
    values = (x, y, first, second, rotated)
    if not all(math.isfinite(v) for v in values) or max(first, second) > 4.0 * max(patch.mask.shape):
        return None, DeclineReason.CLIPPED if sides.any else explain(DeclineReason.ROUND, "no ellipse fits the contour")
    angle = wrap_axial_deg(-rotated if first >= second else -rotated - 90.0)
    return PatchAxis(angle, x, y, max(first, second) / 2.0, min(first, second) / 2.0), None


def skeleton_axis(patch: Patch, line: MiddleLine) -> tuple[PatchAxis | None, str | None]:
    """Fit a straight line to the skeleton, each pixel weighted by its distance to the contour."""
    mass = float(line.weight.sum())
    if line.weight.size < 4 or mass <= 0.0:
        return None, DeclineReason.CLIPPED if patch.clipped.any else DeclineReason.NO_MIDDLE_LINE
    x, y = float(line.weight @ line.x_px) / mass, float(line.weight @ line.y_px) / mass
    dx, dy = line.x_px - x, line.y_px - y
    w = line.weight / mass
    axis = _axis_of_moments(x, y, float(w @ dx**2), float(w @ dy**2), float(w @ (dx * dy)))
    half_width = float(line.weight.max())
    length = axis.long_px * math.sqrt(3.0) / 2.0 + half_width
    if length < 1.6 * half_width or axis.aspect < 2.2 or line.share < LINE_SHARE_MIN:
        return axis, DeclineReason.NO_MIDDLE_LINE
    # The line has no width: its semi-axes are those of the bar whose middle it is.
    return PatchAxis(axis.angle_deg, x, y, length, half_width, axis.short_px / 4.0), None


FIT_AXIS = {"moments": _moments_axis, "pca": _pca_axis, "ellipse": _ellipse_axis}
