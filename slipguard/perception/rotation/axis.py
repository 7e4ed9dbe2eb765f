"""Estimates the axis of a contact patch by four estimators and their weighted mean, or declines it.

`moments`: second moments of the probability; `pca`: of the mask; `ellipse`: fitted to the contour; `skeleton`: a line
through the thinned patch. Each returns a sigma, or the reason why there is no axis.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from slipguard.perception.contact.patch import Patch
from slipguard.perception.declined import DeclineReason, explain
from slipguard.perception.estimate import AxisEstimate, StageTimer
from slipguard.perception.rotation.axial_angle import axial_difference_deg, axial_mean_deg
from slipguard.perception.rotation.fusion import RotationEstimate, fuse_axis_rotations, rotation_between_axes
from slipguard.perception.rotation.patch_axis import FIT_AXIS, PatchAxis, coarse_step, cut_share, skeleton_axis
from slipguard.perception.rotation.round_contact import round_axis_reason
from slipguard.perception.rotation.skeleton import MiddleLine, middle_line
from slipguard.perception.settings import EstimatorName

ESTIMATORS = ("moments", "ellipse", "pca", "skeleton")
FUSED_ESTIMATORS = ("moments", "ellipse", "skeleton")
"""The estimators that the setting "fused" averages."""
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


PatchAxes = Mapping[str, AxisEstimate]
"""The axes of one patch, by estimator."""


class AxisEstimation:
    """Estimates the axes of patches with the estimators that the settings ask for: the fast one first.

    Args:
        name: The setting; "fused" and "registration" use `moments` as the fast estimator.
        round_aspect: Smallest aspect of a patch with an axis.
        skip_round: Whether a patch without an axis is not thinned.
    """

    def __init__(self, name: EstimatorName, round_aspect: float, skip_round: bool = True) -> None:
        self._name = name
        self._fast = "moments" if name in ("fused", "registration") else str(name)
        self._round_aspect = round_aspect
        self._skip_round = skip_round

    def fast(self, patch: Patch, timer: StageTimer) -> PatchAxes:
        """Return the axis by one estimator."""
        if self._fast == "skeleton":
            return self._skeleton(patch, {}, timer)
        axis = estimate_axis(patch, self._fast, self._round_aspect)
        timer.mark("angle")
        return {self._fast: axis}

    def all(self, patch: Patch, fast: PatchAxes, timer: StageTimer) -> PatchAxes:
        """Return the axes by every estimator, given those by the fast one."""
        if self._name != "fused":
            return fast
        axes = dict(fast)
        readable = axes[self._fast].declined is None
        if readable:
            axes["ellipse"] = estimate_axis(patch, "ellipse", self._round_aspect)
            timer.mark("angle")
        if readable or not self._skip_round:
            return self._skeleton(patch, axes, timer)
        return axes

    def _skeleton(self, patch: Patch, others: PatchAxes, timer: StageTimer) -> PatchAxes:
        line = middle_line(patch, coarse_step(patch.mask))
        timer.mark("thin")
        axis = _skeleton_estimate(patch, line, self._round_aspect)
        timer.mark("angle")
        return {**others, "skeleton": axis}


def estimate_axis(patch: Patch, name: str, round_aspect: float = ROUND_ASPECT) -> AxisEstimate:
    """Estimate the axis of a patch by `name`, one of `ESTIMATORS`; never raises on any patch."""
    if name == "skeleton":
        return _skeleton_estimate(patch, middle_line(patch, coarse_step(patch.mask)), round_aspect)
    axis, declined = FIT_AXIS[name](patch)
    return _checked_axis(patch, name, axis, declined, round_aspect)


def fuse_axes(estimates: list[AxisEstimate]) -> AxisEstimate:
    """Return one axis from several estimates of the same patch: the axial mean weighted by 1 / sigma^2.

    All errors come from one mask, so sigma is that of the best, widened by the others' distance from the mean.
    Declined if all decline (with the first reason) or if they contradict each other.
    """
    given = [(a, a.angle_deg, a.sigma_deg) for a in estimates if a.angle_deg is not None and a.sigma_deg is not None]
    first = estimates[0]
    if not given:
        return AxisEstimate("fused", None, None, first.center_px, first.declined)
    weights = [1.0 / sigma**2 for _, _, sigma in given]
    mean = axial_mean_deg([angle for _, angle, _ in given], weights)
    spread = sum(w * axial_difference_deg(angle, mean) ** 2 for w, (_, angle, _) in zip(weights, given, strict=True))
    sigma = math.sqrt(min(s for _, _, s in given) ** 2 + 0.25 * spread / sum(weights))
    if spread > 25.0 * len(given):
        return AxisEstimate("fused", None, None, given[0][0].center_px, DeclineReason.DISAGREE)
    return AxisEstimate("fused", mean, sigma, given[0][0].center_px)


def rotation_of_axes(before: PatchAxes, now: PatchAxes, near_deg: float) -> RotationEstimate:
    """Return the rotation from the reference's axes to those of a patch, estimator by estimator, fused.

    near_deg: the expected rotation, which resolves the ambiguity of 180 degrees.
    """
    rotations = []
    for name, axis in now.items():
        first = before.get(name)
        if first is None:
            continue
        if first.angle_deg is None or first.sigma_deg is None:
            rotations.append(RotationEstimate(None, None, first.declined))
        elif axis.angle_deg is None or axis.sigma_deg is None:
            rotations.append(RotationEstimate(None, None, axis.declined))
        else:
            rotations.append(
                rotation_between_axes(axis.angle_deg, axis.sigma_deg, first.angle_deg, first.sigma_deg, near_deg)
            )
    return fuse_axis_rotations(rotations)


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
    if declined is None:
        declined = round_axis_reason(axis.aspect, round_aspect)
    if declined is None and not axis.aspect >= round_aspect + CUT_ASPECT * share:
        detail = f"aspect {axis.aspect:.2f}, limit {round_aspect + CUT_ASPECT * share:.2f} for a cut contact"
        declined = explain(DeclineReason.CLIPPED, detail)
    if declined is not None:
        return AxisEstimate(name, None, None, center, declined)
    contour_px = math.hypot(_CONTOUR_PX[name], axis.rough_px, patch.ragged_px)
    sigma = axis.sigma_deg(contour_px * (1.0 + CUT_SIGMA * share))
    return AxisEstimate(name, axis.angle_deg, sigma, center)
