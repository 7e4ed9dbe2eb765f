"""Axes on and next to +-90 degrees, and turns that cross there; axial arithmetic on huge and tiny angles."""

from __future__ import annotations

import math

import numpy as np

from slipguard.perception.rotation.axial_angle import (
    axial_difference_deg,
    axial_mean_deg,
    nearest_rotation_deg,
    wrap_axial_deg,
)
from slipguard.stress.family import FamilyResults, TrialFamily, TrialFunction
from slipguard.stress.map_checks import patch_of, read
from slipguard.stress.product_functions import MAP_PX, ProductFunctions
from slipguard.stress.rotating_shapes import rotation_held
from slipguard.stress.shapes import ALONG_U, ShapePose, soft

OFFSETS_DEG = (0.0, 1e-12, -1e-12, 1e-6, -1e-6, 0.01, -0.01, 0.3, -0.3, 2.0, -2.0)
SEAMS_DEG = (90.0, -90.0, 0.0, 180.0, -180.0, 45.0, -45.0, 270.0)


def _begin(product: ProductFunctions) -> TrialFunction:
    names = tuple(ALONG_U)

    def trial(rng: np.random.Generator, seed: int, results: FamilyResults) -> None:
        _check_axial(rng, results)
        shape = ALONG_U[names[seed % len(names)]]
        seam = SEAMS_DEG[seed // len(names) % len(SEAMS_DEG)]
        angle = seam + OFFSETS_DEG[seed // (len(names) * len(SEAMS_DEG)) % len(OFFSETS_DEG)]
        centre = (59.5, 79.5) if rng.random() < 0.5 else (rng.uniform(52, 67), rng.uniform(70, 89))
        pose = ShapePose(angle, *centre)
        patch = patch_of(soft(shape, pose), 100.0, MAP_PX, product, results)
        if patch is not None:
            for reader, found in read(patch, product, results).items():
                results.check_angle(reader, found.angle_deg, found.sigma_deg, angle, axial=True)
        rotation = float(rng.choice((-1.0, 1.0)) * rng.uniform(4, 24))
        across = ShapePose(angle - rotation / 2, *centre), ShapePose(angle + rotation / 2, *centre)
        rotation_held(shape, *across, product, results, (None, None))

    return trial


def _check_axial(rng: np.random.Generator, results: FamilyResults) -> None:
    """Axial arithmetic against IEEE remainders, on seams, their neighbours in float64, and huge angles."""
    seam = float(rng.choice(SEAMS_DEG))
    value = float(rng.choice((seam, math.nextafter(seam, 1e9), math.nextafter(seam, -1e9), rng.normal(0, 1e3),
                              rng.normal(0, 1e9), 5e-324)))  # fmt: skip
    near = float(rng.normal(0, 1e4))
    wrapped = results.call("wrap", wrap_axial_deg, value)
    rotated = results.call("unwrap", nearest_rotation_deg, value, near)
    apart = results.call("difference", axial_difference_deg, value, near)
    mean = results.call("mean", axial_mean_deg, [value, value + 180.0, value - 180.0], [1.0, 2.0, 3.0])
    for what, result in (("wrapped axis", wrapped), ("axial difference", apart), ("axial mean", mean)):
        if result is not None and results.check_finite(what, result) and not -90.0 < result <= 90.0:
            results.add_failure("limit", f"{what} of {value!r} is {result!r}, not in (-90, 90]")
    rounding = 1e-9 + 1e-13 * abs(value)
    for what, result in (("wrapped axis", wrapped), ("unwrapped turn", rotated), ("axial mean", mean)):
        if result is not None and math.isfinite(result):
            results.check_limit(
                f"{what}, error in roundings", abs(math.remainder(result - value, 180.0)) / rounding, 100.0
            )
    if rotated is not None and math.isfinite(rotated) and abs(rotated - near) > 90.0 + rounding:
        results.add_failure("limit", f"the turn nearest {near!r} of {value!r} is {rotated!r}")


CASES = len(ALONG_U) * len(SEAMS_DEG) * len(OFFSETS_DEG)
SEAMS = TrialFamily("seams", "axes on and next to ±90°, turns across", 5 * CASES, 10.0, _begin, min_answered_share=0.9)
