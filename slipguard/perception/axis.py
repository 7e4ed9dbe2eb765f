"""The axis of a contact's mask by four estimators: orientation, comparison, and rotation without a background image.

`moments`: second moments of the probability; `pca`: of the mask; `ellipse`: fitted to the contour; `skeleton`: a line
through the thinned patch. An axis has no head: angles are equal modulo 180 degrees.

Sigma is the same for all: an ellipse with the semi-axes a > b that rotates by a radian moves its contour by
(a^2 - b^2) / (2 sqrt(a^2 + b^2)) (r.m.s.), so a contour error turns it by its ratio to that. Where the frame cuts a bar
at an angle phi from square, the axis of what is left turns by tan(phi) b^2 / (a^2 - b^2), half of it for one end: that
is taken as two standard deviations.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.perception.estimate import AxisEstimate, DeclineReason, RotationEstimate, explain
from slipguard.perception.patch import Patch
from slipguard.perception.skeleton import thin

ESTIMATORS = ("moments", "ellipse", "pca", "skeleton")
CONTOUR_PX = 0.35
"""Standard deviation of the contour, network pixels: smooth errors of the network that do not average out."""
RAGGED_PX, RAGGED_GAIN = 9, 1.5
"""A contour is ragged where a median over so many pixels moves it, and as uncertain as this times that motion."""
SMALLEST_PX = 40
"""Smallest patch with an axis, network pixels."""
ROUND_ASPECT = 1.15
SIGMA_MAX_DEG = 6.0
"""Default limits of the configuration."""
LINE_ASPECT = 2.2
"""A skeleton is a line from this ratio of its length to its width on, r.m.s."""
CORNER_SLOPE = 0.5
"""Along a line of the skeleton the distance to the contour changes by the sine of half the angle between the two sides
that it bisects: 0.7 towards a right corner, near 0 along a bar. A steeper line is a branch into a corner."""


@dataclass(frozen=True, slots=True)
class _Ellipse:
    """A fitted ellipse in crop coordinates. long_px, short_px: semi-axes. rough_px: r.m.s. residual of the fit."""

    angle_deg: float
    x_px: float
    y_px: float
    long_px: float
    short_px: float
    rough_px: float = 0.0


def wrap_axial_deg(angle_deg: float) -> float:
    """Return the same axis in (-90, 90]."""
    wrapped = math.fmod(angle_deg, 180.0)
    if wrapped > 90.0:
        return wrapped - 180.0
    return wrapped + 180.0 if wrapped <= -90.0 else wrapped


def axial_difference_deg(now_deg: float, before_deg: float) -> float:
    """Return the smallest rotation from axis `before_deg` to axis `now_deg`, in (-90, 90].

    >>> axial_difference_deg(-80.0, 80.0)
    20.0
    """
    return wrap_axial_deg(now_deg - before_deg)


def nearest_rotation_deg(axial_deg: float, near_deg: float) -> float:
    """Unwrap an axis: return the rotation nearest `near_deg` of those that differ from `axial_deg` by 180 degrees."""
    return near_deg + wrap_axial_deg(axial_deg - near_deg)


def estimate_axis(patch: Patch, name: str, round_aspect: float = ROUND_ASPECT) -> AxisEstimate:
    """Estimate the axis of a patch by `name`, one of `ESTIMATORS`, or decline it; never raises on any patch.

    round_aspect: a patch with a smaller ratio of its axes is round.
    """
    if np.count_nonzero(patch.mask) < SMALLEST_PX or (ellipse := _FITS[name](patch)) is None:
        return AxisEstimate(name, None, None, None, DeclineReason.CONTACT_TOO_SMALL)
    center = patch.to_frame(ellipse.x_px, ellipse.y_px)
    aspect = ellipse.long_px / max(ellipse.short_px, 1e-6)
    sigma_deg = _sigma_deg(patch, ellipse)
    declined = None
    if not aspect >= round_aspect:
        declined = explain(DeclineReason.ROUND, f"aspect {aspect:.2f}, limit {round_aspect:.2f}")
    elif not sigma_deg <= SIGMA_MAX_DEG:
        declined = explain(DeclineReason.UNCERTAIN, f"sigma {sigma_deg:.1f} deg, limit {SIGMA_MAX_DEG:g} deg")
    if declined is not None:
        return AxisEstimate(name, None, None, center, declined)
    return AxisEstimate(name, ellipse.angle_deg, sigma_deg, center)


def rotation_between_axes(now: AxisEstimate, before: AxisEstimate, near_deg: float) -> RotationEstimate:
    """Return the rotation between two axes, of all that differ by 180 degrees the one nearest `near_deg`.

    From -6 to +6 it is +12, from 80 to 100 (the axis -80) it is +20.
    """
    if now.angle_deg is None or now.sigma_deg is None:
        return RotationEstimate(None, None, now.declined)
    if before.angle_deg is None or before.sigma_deg is None:
        return RotationEstimate(None, None, before.declined)
    rotation_deg = nearest_rotation_deg(now.angle_deg - before.angle_deg, near_deg)
    return RotationEstimate(rotation_deg, math.hypot(now.sigma_deg, before.sigma_deg))


def _sigma_deg(patch: Patch, ellipse: _Ellipse) -> float:
    """Return one standard deviation of the axis."""
    a2, b2 = ellipse.long_px**2, ellipse.short_px**2
    if not a2 > b2:
        return math.inf
    contours, _ = cv2.findContours(patch.mask, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    moved = np.count_nonzero(patch.mask != cv2.medianBlur(patch.mask, RAGGED_PX))
    ragged_px = RAGGED_GAIN * moved / sum(len(contour) for contour in contours)
    contour = math.hypot(CONTOUR_PX, ellipse.rough_px, ragged_px) * 2.0 * math.sqrt(a2 + b2) / (a2 - b2)
    mask, slope = patch.mask, abs(math.tan(math.radians(ellipse.angle_deg))) + 1e-9
    upright, level = (np.count_nonzero(one[0]) + np.count_nonzero(one[-1]) for one in (mask.T, mask))  # 0 if not cut
    oblique = (slope * upright + level / slope) / (8.0 * max(ellipse.short_px, 1.0))
    return math.degrees(math.hypot(contour, oblique * b2 / (a2 - b2)))


def _ellipse_of_moments(x: float, y: float, xx: float, yy: float, xy: float) -> _Ellipse:
    """Return the ellipse with these second central moments, y downwards."""
    middle, half = (xx + yy) / 2.0, math.hypot((xx - yy) / 2.0, xy)
    angle_deg = wrap_axial_deg(-math.degrees(math.atan2(2.0 * xy, xx - yy)) / 2.0)
    return _Ellipse(angle_deg, x, y, 2.0 * math.sqrt(max(middle + half, 0.0)), 2.0 * math.sqrt(max(middle - half, 0.0)))


def _fit_moments(weights: NDArray[np.float32] | NDArray[np.uint8]) -> _Ellipse | None:
    m = cv2.moments(weights)
    mass = m["m00"]
    if not mass > 0.0:
        return None
    return _ellipse_of_moments(m["m10"] / mass, m["m01"] / mass, m["mu20"] / mass, m["mu02"] / mass, m["mu11"] / mass)


def _fit_contour(patch: Patch) -> _Ellipse | None:
    """Fit an ellipse to the contour, without the points on the frame's edge: elsewhere a crop has a margin."""
    contours, _ = cv2.findContours(patch.mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    points = np.concatenate(contours)[:, 0]
    rows, columns = patch.mask.shape
    points = points[((points > 0) & (points < (columns - 1, rows - 1))).all(axis=1)]
    if len(points) < 6:
        return None
    (x, y), (first, second), angle_deg = cv2.fitEllipseDirect(points.astype(np.float32))
    long_px, short_px = max(first, second) / 2.0, min(first, second) / 2.0
    if not all(math.isfinite(one) for one in (x, y, first, second)) or long_px > 2.0 * max(rows, columns):
        return None
    angle_deg = wrap_axial_deg(-angle_deg if first >= second else -angle_deg - 90.0)
    return _Ellipse(angle_deg, x, y, long_px, short_px)


def _fit_skeleton(patch: Patch) -> _Ellipse | None:
    """Fit a line to the skeleton without branches into corners, each pixel weighted by its distance to the contour."""
    inside = cv2.distanceTransform(patch.mask, cv2.DIST_L2, 5)
    slope_x, slope_y = (cv2.Sobel(inside, cv2.CV_32F, *axis, ksize=5, scale=1 / 128) for axis in ((1, 0), (0, 1)))
    line = np.where(slope_x**2 + slope_y**2 < CORNER_SLOPE**2, thin(patch.mask) * inside, 0.0).astype(np.float32)
    fit = _fit_moments(line)
    if fit is None:
        return None
    # The line has no width: its semi-axes are those of the bar whose middle it is.
    half_width_px, half_length_px = float(line.max()), math.sqrt(3.0) / 2.0 * fit.long_px
    if half_length_px < 0.5 * half_width_px or fit.long_px < LINE_ASPECT * fit.short_px:
        half_length_px = 0.0  # a corner branch that was kept, or branches that are no line
    long_px = half_length_px + half_width_px
    return _Ellipse(fit.angle_deg, fit.x_px, fit.y_px, long_px, half_width_px, fit.short_px / 2.0)


_FITS = {
    "moments": lambda patch: _fit_moments(patch.probability),
    "pca": lambda patch: _fit_moments(patch.mask),
    "ellipse": _fit_contour,
    "skeleton": _fit_skeleton,
}
