"""What must hold for every mask: thinned as OpenCV thins it, read honestly, and turning as its picture turns."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from slipguard.perception.contact.patch import Patch
from slipguard.perception.estimate import AxisEstimate
from slipguard.perception.rotation.axis import ESTIMATORS, FUSED_ESTIMATORS, fuse
from slipguard.perception.rotation.contour_registration import ContourPose
from slipguard.perception.rotation.contour_template import make_contour_template
from slipguard.stress.masks import Mask, opencv_thinned, rotated, rotated_axis_deg
from slipguard.stress.product_functions import THRESHOLD, ProductFunctions
from slipguard.stress.trial_family import FamilyResults

Map = NDArray[np.float32]


def check_thinning(mask: Mask, product: ProductFunctions, results: FamilyResults) -> None:
    """The thinned mask is OpenCV's, pixel for pixel."""
    thinned = results.call("thin", product.thin, mask)
    if thinned is None:
        return
    wrong = int(np.count_nonzero(thinned != opencv_thinned(mask)))
    results.check_limit("thinning, pixels unlike OpenCV's", float(wrong), 0.0)


def patch_of(
    probability: Map, min_area_px: float, frame_px: float, product: ProductFunctions, results: FamilyResults
) -> Patch | None:
    """The patch in a map, checked; None where there is none."""
    patch = results.call("regions", product.find_patch, probability, THRESHOLD, min_area_px, frame_px)
    if patch is None:
        return None
    if not np.isfinite(patch.probability).all():
        results.add_failure("nan", "the patch's probability is not finite")
    if patch.mask.max() > 1 or patch.mask.shape != patch.probability.shape:
        results.add_failure("limit", f"the patch's mask goes up to {patch.mask.max()}")
    if (patch.full_mask() > (probability > THRESHOLD)).any():
        results.add_failure("limit", "the patch has pixels that are no contact")
    return patch


def read(patch: Patch, product: ProductFunctions, results: FamilyResults) -> dict[str, AxisEstimate]:
    """The axis by every estimator, and fused from these; an answer must be in range with a sigma, a refusal say why."""
    said = {name: results.call(name, product.estimate, patch, name) for name in ESTIMATORS}
    parts = [found for name in FUSED_ESTIMATORS if (found := said[name]) is not None]
    said["fused"] = results.call("fused", fuse, parts) if len(parts) == len(FUSED_ESTIMATORS) else None
    answers = {}
    for name, found in said.items():
        if found is None:
            continue
        angle = found.angle_deg
        if not results.check_finite(name, angle, found.sigma_deg, *(found.center_px or ())):
            continue
        if (angle is None) == (found.declined is None) or (angle is None) != (found.sigma_deg is None):
            results.add_failure("limit", f"{name}: angle {angle}, sigma {found.sigma_deg}, declined {found.declined}")
        elif angle is not None and not -90.0 < angle <= 90.0:
            results.add_failure("limit", f"{name}: axis {angle}° is not in (-90, 90]")
        else:
            answers[name] = found
    return answers


def compare(
    before: dict[str, AxisEstimate], now: dict[str, AxisEstimate], rotation_deg: float | None, results: FamilyResults
) -> dict[str, float | None]:
    """Judge the turn between two readings, estimator by estimator; the errors without sign, None where declined."""
    errors: dict[str, float | None] = {}
    for name in before.keys() & now.keys():
        a, b = before[name], now[name]
        rotation = sigma = None
        if None not in (a.angle_deg, b.angle_deg, a.sigma_deg, b.sigma_deg):
            rotation = (b.angle_deg or 0.0) - (a.angle_deg or 0.0)
            sigma = math.hypot(a.sigma_deg or 0.0, b.sigma_deg or 0.0)
        errors[name] = results.check_angle(name, rotation, sigma, rotation_deg, axial=True)
    return errors


def check_rotated(
    probability: Map, which: int, min_area_px: float, frame_px: float, product: ProductFunctions, results: FamilyResults
) -> None:
    """A picture mirrored or turned by quarter turns reads the same axis, mirrored or turned."""
    patch = patch_of(probability, min_area_px, frame_px, product, results)
    if patch is None:
        return
    here = read(patch, product, results)
    there = np.asarray(rotated(probability, which), np.float32)
    other = patch_of(there, min_area_px, frame_px, product, results)
    if other is None:
        results.add_failure("limit", "a patch is lost when its picture is turned")
        return
    now = read(other, product, results)
    for name in here.keys() & now.keys():
        angle, sigma = here[name].angle_deg, here[name].sigma_deg
        if angle is None or sigma is None:
            continue
        expected = rotated_axis_deg(angle, which)
        own = now[name].sigma_deg
        both = None if own is None else math.hypot(own, sigma)
        results.check_angle(name, now[name].angle_deg, both, expected, axial=True)


def check_laid_over_itself(patch: Patch, product: ProductFunctions, results: FamilyResults) -> None:
    """A patch laid over itself has not turned, whatever it is."""

    def lay() -> tuple[float | None, float | None]:
        registration = product.registrar(make_contour_template(patch), patch).fit(ContourPose())
        pose = registration.pose
        results.check_finite(
            "registration", pose.rotation_deg, pose.dx_px, pose.dy_px, *pose.growth, registration.sigma_deg
        )
        said = registration.declined is None
        return (pose.rotation_deg if said else None, registration.sigma_deg if said else None)

    laid = results.call("registration", lay)
    if laid is not None:
        results.check_angle("registration", *laid, 0.0, axial=False)
