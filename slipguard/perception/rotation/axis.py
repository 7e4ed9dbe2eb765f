"""Four ways to tell the axis of a patch, behind one interface, each with an honest sigma or a reason why there is none.

`moments` second moments of the probability; `pca` of the mask; `ellipse` fitted to the outline; `skeleton` a line
through the thinned patch; `fused` their mean, weighted by sigma.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.perception.contact.patch import Patch
from slipguard.perception.estimate import AxisEstimate
from slipguard.perception.rotation.axial_angle import axial_difference_deg, axial_mean_deg, wrap_axial_deg
from slipguard.perception.rotation.skeleton import MiddleLine, middle_line

ESTIMATORS = ("moments", "ellipse", "pca", "skeleton")
FUSED_ESTIMATORS = ("moments", "ellipse", "skeleton")
"""Those whose mean `fused` is."""
ROUND_ASPECT = 1.15
LINE_SHARE_MIN = 0.3
"""Where most of the thinned patch is corner branches its middle line is no axis."""
LINE_SIGMA_MAX_DEG = 6.0
"""A middle line less sure than this is none: which of a torn patch's branches it follows is chance."""
CUT_SHARE_MAX = 0.25
"""A patch with more of its outline drawn by the frame's edge shows no axis of its own."""
CUT_ASPECT = 2.5
CUT_SIGMA = 6.0
"""How much more elongated a cut patch must be, and how much less certain it is, per share of outline cut."""
EVEN_SHARE = 0.1
"""What every other row and column shows of a patch differs by less than this share, wherever one begins to count."""
SMALLEST_PX = 40
"""Fewer network pixels than this tell no axis."""
_OUTLINE_PX = {"moments": 0.30, "pca": 0.33, "ellipse": 0.45, "skeleton": 0.4}
"""Standard deviation of the outline's place, network pixels, as each estimator feels it: smooth errors of the network
that no averaging removes."""
_TOO_FEW = "contact too small"
_ROUND = "round contact"
_CLIPPED = "clipped by the frame"
_NO_LINE = "no straight middle line"
_DISAGREE = "estimators disagree"


@dataclass(frozen=True, slots=True)
class PatchAxis:
    """An axis in crop coordinates. long_px, short_px: semi-axes of the ellipse with the same second moments.

    rough_px: how far what was fitted is from what it was fitted to, where that says how far to trust it.
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

    def sigma_deg(self, outline_px: float) -> float:
        """How far the axis turns where the outline is wrong by `outline_px`.

        An ellipse that turns by a radian moves its outline by (a^2 - b^2) / (2 sqrt(a^2 + b^2)) on average (r.m.s.).
        """
        a2, b2 = self.long_px**2, self.short_px**2
        lever_px = (a2 - b2) / (2.0 * math.sqrt(a2 + b2) + 1e-9)
        return math.degrees(outline_px / max(lever_px, 1e-3))


def estimate(patch: Patch, name: str, round_aspect: float = ROUND_ASPECT) -> AxisEstimate:
    """The axis of a patch by the estimator `name`, one of `ESTIMATORS` or `fused`; never raises on any patch."""
    if name == "fused":
        return fuse([estimate(patch, each, round_aspect) for each in FUSED_ESTIMATORS])
    if name == "skeleton":
        return skeleton_orientation(patch, middle_line(patch), round_aspect)
    axis, reason = _AXES[name](patch)
    return _orientation(patch, name, axis, reason, round_aspect)


def skeleton_orientation(patch: Patch, line: MiddleLine, round_aspect: float = ROUND_ASPECT) -> AxisEstimate:
    """The axis by a line that is already thinned (the pipeline times thinning apart)."""
    axis, reason = _skeleton_axis(patch, line)
    told = _orientation(patch, "skeleton", axis, reason, round_aspect)
    if told.sigma_deg is None or told.sigma_deg <= LINE_SIGMA_MAX_DEG:
        return told
    return AxisEstimate("skeleton", None, None, told.center_px, _NO_LINE)


def fuse(answers: list[AxisEstimate]) -> AxisEstimate:
    """One orientation from several of the same patch: the axial mean weighted by 1 / sigma^2.

    The errors are those of one mask, so sigma is that of the best, widened by how far the others are from the mean;
    declined where all decline (the first one's reason) or where they contradict each other.
    """
    said = [(a, a.angle_deg, a.sigma_deg) for a in answers if a.angle_deg is not None and a.sigma_deg is not None]
    first = answers[0]
    if not said:
        return AxisEstimate("fused", None, None, first.center_px, first.declined)
    weights = [1.0 / sigma**2 for _, _, sigma in said]
    mean = axial_mean_deg([angle for _, angle, _ in said], weights)
    spread = sum(w * axial_difference_deg(angle, mean) ** 2 for w, (_, angle, _) in zip(weights, said, strict=True))
    sigma = math.sqrt(min(s for _, _, s in said) ** 2 + 0.25 * spread / sum(weights))
    if spread > 25.0 * len(said):
        return AxisEstimate("fused", None, None, said[0][0].center_px, _DISAGREE)
    return AxisEstimate("fused", mean, sigma, said[0][0].center_px)


def _orientation(
    patch: Patch, name: str, axis: PatchAxis | None, reason: str | None, round_aspect: float
) -> AxisEstimate:
    if axis is None:
        return AxisEstimate(name, None, None, None, reason)
    centre = patch.to_frame(axis.x_px, axis.y_px)
    cut_share = _cut_share(patch) if patch.clipped.any else 0.0
    if reason is None and cut_share > CUT_SHARE_MAX:
        reason = _CLIPPED
    if reason is None and not axis.aspect >= round_aspect + CUT_ASPECT * cut_share:
        reason = _CLIPPED if axis.aspect >= round_aspect else _ROUND
    if reason is not None:
        return AxisEstimate(name, None, None, centre, reason)
    outline_px = math.hypot(_OUTLINE_PX[name], axis.rough_px, patch.ragged_px)
    sigma = axis.sigma_deg(outline_px * (1.0 + CUT_SIGMA * cut_share))
    return AxisEstimate(name, axis.angle_deg, sigma, centre)


def _cut_share(patch: Patch) -> float:
    """Share of the outline around all of the patch that the frame's edge drew; of a cut ring the whole chord counts."""
    contours, _ = cv2.findContours(patch.mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    around = cv2.arcLength(cv2.convexHull(np.concatenate(contours)), True)
    cuts = (np.flatnonzero(side) for side in _sides(patch) if side is not None)
    spans = [int(cut[-1]) - int(cut[0]) + 1 for cut in cuts if cut.size]
    return min(sum(spans) / max(around, 1.0), 1.0)


def _sides(patch: Patch) -> tuple[NDArray[np.uint8] | None, ...]:
    """The mask along the left, right, top and bottom of its crop; None where the frame does not cut it there."""
    mask, sides = patch.mask, patch.clipped
    return (
        mask[:, 0] if sides.left else None,
        mask[:, -1] if sides.right else None,
        mask[0] if sides.top else None,
        mask[-1] if sides.bottom else None,
    )


def _axis_of(mean_x: float, mean_y: float, xx: float, yy: float, xy: float) -> PatchAxis:
    """The axis with these second central moments, y downwards."""
    middle, half = (xx + yy) / 2.0, math.hypot((xx - yy) / 2.0, xy)
    angle = wrap_axial_deg(-math.degrees(math.atan2(2.0 * xy, xx - yy)) / 2.0)
    return PatchAxis(
        angle, mean_x, mean_y, 2.0 * math.sqrt(max(middle + half, 0.0)), 2.0 * math.sqrt(max(middle - half, 0.0))
    )


def _axis_of_picture(weights: NDArray[np.float32] | NDArray[np.uint8], binary: bool) -> PatchAxis | None:
    m = cv2.moments(weights, binary)
    mass = m["m00"]
    if mass < SMALLEST_PX:
        return None
    return _axis_of(m["m10"] / mass, m["m01"] / mass, m["mu20"] / mass, m["mu02"] / mass, m["mu11"] / mass)


def _moments_axis(patch: Patch) -> tuple[PatchAxis | None, str | None]:
    return _square_cut(patch, patch.probability, binary=False)


def _pca_axis(patch: Patch) -> tuple[PatchAxis | None, str | None]:
    return _square_cut(patch, patch.mask, binary=True)


def _square_cut(
    patch: Patch, weights: NDArray[np.float32] | NDArray[np.uint8], binary: bool
) -> tuple[PatchAxis | None, str | None]:
    """Second moments; an end cut askew by the frame is first cut square to the axis, so that a bar stays unbiased."""
    axis = _axis_of_picture(weights, binary)
    if axis is None:
        return None, _TOO_FEW
    if not patch.clipped.any:
        return axis, None
    # Big patches are cut at half the resolution: it is four times quicker, and the ends of the patch stay sharp enough.
    step = 2 if weights.size > 4000 and _even(weights) else 1
    coarse = np.ascontiguousarray(weights[::step, ::step])
    edge_x, edge_y = _edge_points(patch)
    across, down = edge_x - np.float32(axis.x_px), edge_y - np.float32(axis.y_px)
    rows, columns = coarse.shape
    x = step * np.arange(columns, dtype=np.float32)[None, :] - np.float32(axis.x_px)
    y = step * np.arange(rows, dtype=np.float32)[:, None] - np.float32(axis.y_px)
    whole = axis
    for _ in range(3):
        c, s = math.cos(math.radians(axis.angle_deg)), -math.sin(math.radians(axis.angle_deg))
        along = across * np.float32(c) + down * np.float32(s)
        after, before = along[along > 0], along[along <= 0]
        furthest = float(after.min()) if after.size else math.inf
        nearest = float(before.max()) if before.size else -math.inf
        u = x * np.float32(c) + y * np.float32(s)
        cut = _axis_of_picture(np.where((u < furthest) & (u > nearest), coarse, coarse.dtype.type(0)), binary)
        if cut is None or abs(axial_difference_deg(cut.angle_deg, whole.angle_deg)) > 30.0:
            return whole, _CLIPPED
        settled = abs(axial_difference_deg(cut.angle_deg, axis.angle_deg)) < 0.1
        axis = PatchAxis(cut.angle_deg, step * cut.x_px, step * cut.y_px, step * cut.long_px, step * cut.short_px)
        if settled:
            break
    return axis, None


def _even(weights: NDArray[np.float32] | NDArray[np.uint8]) -> bool:
    """Whether every other row and column shows the whole: of thin lines some would be left out."""
    quarters = [float(weights[row::2, column::2].sum()) for row in (0, 1) for column in (0, 1)]
    return max(quarters) - min(quarters) <= EVEN_SHARE * max(quarters)


def _edge_points(patch: Patch) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Patch pixels on the sides of the frame that cut it, crop coordinates; one in a corner may come twice."""
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
    """An ellipse through the outline, without the points that the frame's edge drew."""
    contours, _ = cv2.findContours(patch.mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    if not contours or np.count_nonzero(patch.mask) < SMALLEST_PX:
        return None, _TOO_FEW
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
            return None, _CLIPPED
    if len(points) < 12:
        return None, _TOO_FEW
    (x, y), (first, second), rotated = cv2.fitEllipseDirect(points.astype(np.float32))
    values = (x, y, first, second, rotated)
    if not all(math.isfinite(v) for v in values) or max(first, second) > 4.0 * max(patch.mask.shape):
        return None, _CLIPPED if sides.any else _ROUND
    angle = wrap_axial_deg(-rotated if first >= second else -rotated - 90.0)
    return PatchAxis(angle, x, y, max(first, second) / 2.0, min(first, second) / 2.0), None


def _skeleton_axis(patch: Patch, line: MiddleLine) -> tuple[PatchAxis | None, str | None]:
    """A straight line through the thinned patch, each pixel weighted by its distance to the outline."""
    mass = float(line.weight.sum())
    if line.weight.size < 4 or mass <= 0.0:
        return None, _CLIPPED if patch.clipped.any else _NO_LINE
    x, y = float(line.weight @ line.x_px) / mass, float(line.weight @ line.y_px) / mass
    dx, dy = line.x_px - x, line.y_px - y
    w = line.weight / mass
    axis = _axis_of(x, y, float(w @ dx**2), float(w @ dy**2), float(w @ (dx * dy)))
    half_width = float(line.weight.max())
    length = axis.long_px * math.sqrt(3.0) / 2.0 + half_width
    if length < 1.6 * half_width or axis.aspect < 2.2 or line.share < LINE_SHARE_MIN:
        return axis, _NO_LINE
    # The line's own width is nil: its semi-axes are those of the bar that it is the middle of.
    return PatchAxis(axis.angle_deg, x, y, length, half_width, axis.short_px / 4.0), None


_AXES = {"moments": _moments_axis, "pca": _pca_axis, "ellipse": _ellipse_axis}
