"""Checks that must hold for every probability map: thinning, axis estimates, symmetry and registration."""

from __future__ import annotations

import math
from collections.abc import Iterable

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.perception.contact.patch import Patch
from slipguard.perception.estimate import AxisEstimate
from slipguard.perception.rotation.axis import ESTIMATORS, FUSED_ESTIMATORS, fuse_axes
from slipguard.perception.rotation.contour_registration import ContourPose
from slipguard.perception.rotation.contour_template import make_contour_template
from slipguard.stress.product_functions import MAP_PX, THRESHOLD, ProductFunctions, ScriptedPipeline
from slipguard.stress.trial_family import FamilyResults

Map = NDArray[np.float32]


def rotate_and_mirror(array: NDArray[np.generic], which: int) -> NDArray[np.generic]:
    """Return one of eight symmetric versions: `which & 4` mirrors left-right, then `which & 3` quarter turns ccw."""
    return np.ascontiguousarray(np.rot90(np.fliplr(array) if which & 4 else array, which & 3))


def rotated_axis_deg(angle_deg: float, which: int) -> float:
    """Return the axis after `rotate_and_mirror`, not wrapped."""
    return (-angle_deg if which & 4 else angle_deg) + 90.0 * (which & 3)


def check_thinning(mask: NDArray[np.uint8], product: ProductFunctions, results: FamilyResults) -> None:
    """Check that the thinned mask equals OpenCV's result in every pixel."""
    thinned = results.call("thin", product.thin, mask)
    if thinned is None:
        return
    gray = np.where(mask > 0, 255, 0).astype(np.uint8)
    expected = cv2.ximgproc.thinning(gray, thinningType=cv2.ximgproc.THINNING_GUOHALL) > 0
    results.check_limit("thinning, pixels unlike OpenCV's", float(np.count_nonzero(thinned != expected)), 0.0)


def find_checked_patch(
    probability: Map, min_area_px: float, product: ProductFunctions, results: FamilyResults
) -> Patch | None:
    """Return the contact patch of a map after checking its consistency; None if there is no contact."""
    patch = results.call("regions", product.find_patch, probability, THRESHOLD, min_area_px, MAP_PX)
    if patch is None:
        return None
    if not np.isfinite(patch.probability).all():
        results.add_failure("nan", "the patch's probability is not finite")
    if patch.mask.max() > 1 or patch.mask.shape != patch.probability.shape:
        results.add_failure("limit", f"the patch's mask has the maximum {patch.mask.max()}, it must be 1")
    if (patch.full_mask() > (probability > THRESHOLD)).any():
        results.add_failure("limit", "the patch contains pixels without contact")
    return patch


def estimate_axes(patch: Patch, product: ProductFunctions, results: FamilyResults) -> dict[str, AxisEstimate]:
    """Return the axis by every estimator and fused, after checking range, sigma and the reason for declining."""
    found = {name: results.call(name, product.estimate, patch, name) for name in ESTIMATORS}
    parts = [one for name in FUSED_ESTIMATORS if (one := found[name]) is not None]
    found["fused"] = results.call("fused", fuse_axes, parts) if len(parts) == len(FUSED_ESTIMATORS) else None
    valid = {}
    for name, one in found.items():
        if one is None:
            continue
        angle = one.angle_deg
        if not results.check_finite(name, angle, one.sigma_deg, *(one.center_px or ())):
            continue
        if (angle is None) == (one.declined is None) or (angle is None) != (one.sigma_deg is None):
            results.add_failure("limit", f"{name}: angle {angle}, sigma {one.sigma_deg}, declined {one.declined}")
        elif angle is not None and not -90.0 < angle <= 90.0:
            results.add_failure("limit", f"{name}: axis {angle}° is not in (-90, 90]")
        else:
            valid[name] = one
    return valid


def estimate_axes_of_two(
    maps: tuple[Map, Map], product: ProductFunctions, results: FamilyResults
) -> tuple[dict[str, AxisEstimate], dict[str, AxisEstimate]] | None:
    """Return the axes in both maps; None unless both show a contact."""
    first, second = (find_checked_patch(one, 100.0, product, results) for one in maps)
    if first is None or second is None:
        return None
    return estimate_axes(first, product, results), estimate_axes(second, product, results)


def check_axis_change(
    before: dict[str, AxisEstimate], now: dict[str, AxisEstimate], rotation_deg: float | None, results: FamilyResults
) -> dict[str, float | None]:
    """Check the rotation between two maps for each estimator; return the absolute errors, None where declined."""
    errors: dict[str, float | None] = {}
    for name in before.keys() & now.keys():
        a, b = before[name], now[name]
        rotation = sigma = None
        if None not in (a.angle_deg, b.angle_deg, a.sigma_deg, b.sigma_deg):
            rotation = (b.angle_deg or 0.0) - (a.angle_deg or 0.0)
            sigma = math.hypot(a.sigma_deg or 0.0, b.sigma_deg or 0.0)
        errors[name] = results.check_angle(name, rotation, sigma, rotation_deg, axial=True)
    return errors


def check_symmetry(
    probability: Map, which: int, min_area_px: float, product: ProductFunctions, results: FamilyResults
) -> None:
    """Check that a mirrored or rotated map gives the mirrored or rotated axis."""
    patch = find_checked_patch(probability, min_area_px, product, results)
    if patch is None:
        return
    before = estimate_axes(patch, product, results)
    transformed = np.asarray(rotate_and_mirror(probability, which), np.float32)
    other = find_checked_patch(transformed, min_area_px, product, results)
    if other is None:
        results.add_failure("limit", "no patch is found after the map is mirrored or rotated")
        return
    now = estimate_axes(other, product, results)
    for name in before.keys() & now.keys():
        angle, sigma = before[name].angle_deg, before[name].sigma_deg
        if angle is None or sigma is None:
            continue
        own = now[name].sigma_deg
        both = None if own is None else math.hypot(own, sigma)
        results.check_angle(name, now[name].angle_deg, both, rotated_axis_deg(angle, which), axial=True)


def check_registration_with_itself(patch: Patch, product: ProductFunctions, results: FamilyResults) -> None:
    """Check that a patch registered to its own contour has not rotated."""

    def register() -> tuple[float | None, float | None]:
        registration = product.registrar(make_contour_template(patch), patch).fit(ContourPose())
        pose, sigma_deg = registration.pose, registration.sigma_deg
        results.check_finite("registration", pose.rotation_deg, pose.dx_px, pose.dy_px, *pose.growth, sigma_deg)
        return (pose.rotation_deg, sigma_deg) if registration.declined is None else (None, None)

    found = results.call("registration", register)
    if found is not None:
        results.check_angle("registration", *found, 0.0, axial=False)


def check_sequence(
    pipeline: ScriptedPipeline, maps: Iterable[tuple[Map, float | None]], results: FamilyResults
) -> float | None:
    """Process maps with their true rotations (None: no rotation is visible) and check each estimate.

    Returns:
        The absolute error of the last estimate in degrees; None if it was declined.
    """
    error = None
    for probability, truth_deg in maps:
        estimate = results.call("pipeline", pipeline.process, probability)
        error = None if estimate is None else results.check_rotation("pipeline", estimate, truth_deg)
    return error
