"""Checks that must hold for every probability map: thinning, patch, axis estimates, and the whole pipeline."""

from __future__ import annotations

import math
from collections.abc import Iterable
from itertools import repeat

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.perception.axis import ESTIMATORS
from slipguard.perception.estimate import AxisEstimate
from slipguard.perception.patch import Patch
from slipguard.stress.product_functions import MAP_PX, THRESHOLD, ProductFunctions, ScriptedPipeline
from slipguard.stress.trial_family import FamilyResults

Map = NDArray[np.float32]


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
    """Return the axis by every estimator after checking range, sigma and the reason for declining."""
    valid = {}
    for name in ESTIMATORS:
        one = results.call(name, product.estimate, patch, name)
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


def check_sequence(
    pipeline: ScriptedPipeline,
    maps: Iterable[tuple[Map, float | None]],
    results: FamilyResults,
    label: str = "pipeline",
    images: Iterable[NDArray[np.uint8] | None] = repeat(None),
) -> float | None:
    """Process maps with their true rotations (None: no rotation is visible) and check each estimate.

    images: Of these frames; without them for a pipeline without a background image.

    Returns:
        The absolute error of the last estimate in degrees; None if it was declined.
    """
    error = None
    for (probability, truth_deg), image in zip(maps, images, strict=False):
        estimate = results.call(label, pipeline.process, probability, image)
        error = None if estimate is None else results.check_rotation(label, estimate, truth_deg)
    return error
