"""Estimates the axis of a contact patch by one of four estimators, or declines it: the paper's way, for comparison.

`moments`: second moments of the probability; `pca`: of the mask; `ellipse`: fitted to the contour; `skeleton`: a line
through the thinned patch. Each returns a sigma, or the reason why there is no axis.
"""

from __future__ import annotations

import math

from slipguard.perception.axial_angle import nearest_rotation_deg
from slipguard.perception.declined import DeclineReason, explain
from slipguard.perception.estimate import AxisEstimate, RotationEstimate
from slipguard.perception.patch import Patch, ragged_px
from slipguard.perception.patch_axis import FIT_AXIS, PatchAxis, coarse_step, cut_share, skeleton_axis
from slipguard.perception.skeleton import MiddleLine, middle_line

ESTIMATORS = ("moments", "ellipse", "pca", "skeleton")
ROUND_ASPECT = 1.15
LINE_SIGMA_MAX_DEG = 6.0
"""A middle line with a larger sigma is declined: which branch of a torn patch it follows is chance."""
CUT_SHARE_MAX = 0.25
"""A patch with a larger share of its contour on the frame's edge has no axis of its own."""
CUT_ASPECT = 2.5
CUT_SIGMA = 6.0
"""Additional aspect that a cut patch needs, and increase of its sigma, per share of contour cut."""
_CONTOUR_PX = {"moments": 0.30, "pca": 0.33, "ellipse": 0.45, "skeleton": 0.4}
"""Standard deviation of the contour's position, network pixels, as it affects each estimator: smooth errors of the
network that do not average out."""


def estimate_axis(patch: Patch, name: str, round_aspect: float = ROUND_ASPECT) -> AxisEstimate:
    """Estimate the axis of a patch by `name`, one of `ESTIMATORS`; never raises on any patch."""
    if name == "skeleton":
        return _skeleton_estimate(patch, middle_line(patch, coarse_step(patch.mask)), round_aspect)
    axis, declined = FIT_AXIS[name](patch)
    return _checked_axis(patch, name, axis, declined, round_aspect)


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


def _skeleton_estimate(patch: Patch, line: MiddleLine, round_aspect: float) -> AxisEstimate:
    axis, declined = skeleton_axis(patch, line)
    estimate = _checked_axis(patch, "skeleton", axis, declined, round_aspect)
    if estimate.sigma_deg is None or estimate.sigma_deg <= LINE_SIGMA_MAX_DEG:
        return estimate
    return AxisEstimate("skeleton", None, None, estimate.center_px, DeclineReason.NO_MIDDLE_LINE)


def _checked_axis(
    patch: Patch, name: str, axis: PatchAxis | None, declined: str | None, round_aspect: float
) -> AxisEstimate:
    """Add center and sigma to an axis, or decline it if the patch is round or cut by the frame."""
    if axis is None:
        return AxisEstimate(name, None, None, None, declined)
    center = patch.to_frame(axis.x_px, axis.y_px)
    share = cut_share(patch) if patch.clipped.any else 0.0
    if declined is None and share > CUT_SHARE_MAX:
        detail = f"{share:.0%} of the contour lies on the frame's edge, limit {CUT_SHARE_MAX:.0%}"
        declined = explain(DeclineReason.CLIPPED, detail)
    if declined is None and not axis.aspect >= round_aspect:
        declined = explain(DeclineReason.ROUND, f"aspect {axis.aspect:.2f}, limit {round_aspect:.2f}")
    if declined is None and not axis.aspect >= round_aspect + CUT_ASPECT * share:
        detail = f"aspect {axis.aspect:.2f}, limit {round_aspect + CUT_ASPECT * share:.2f} for a cut contact"
        declined = explain(DeclineReason.CLIPPED, detail)
    if declined is not None:
        return AxisEstimate(name, None, None, center, declined)
    contour_px = math.hypot(_CONTOUR_PX[name], axis.rough_px, ragged_px(patch.mask))
    sigma = axis.sigma_deg(contour_px * (1.0 + CUT_SIGMA * share))
    return AxisEstimate(name, axis.angle_deg, sigma, center)
