"""Trial family on drawn shapes: the axis estimators, which `measure` offers without a background image."""

from __future__ import annotations

import math

import numpy as np

from slipguard.perception.axial_angle import axial_difference_deg, nearest_rotation_deg, wrap_axial_deg
from slipguard.stress import shapes
from slipguard.stress.map_checks import Map, check_axis_change, check_sequence, estimate_axes_of_two
from slipguard.stress.product_functions import ProductFunctions, ScriptedPipeline
from slipguard.stress.shapes import ALONG_U, ELONGATED, ShapePose, check_rotating_shape, probability_map, roughness
from slipguard.stress.trial_family import FamilyResults, TrialFamily, TrialFunction

CONTOUR_ERRORS_PX = (0.0, 0.1, 0.2, 0.3, 0.5, 0.7, 1.0, 1.5, 2.0, 3.0)
"""Standard deviations of the contour's position in network pixels; that of the shipped network is about 0.3."""
OFFSETS_DEG = (0.0, 1e-12, -1e-12, 1e-6, -1e-6, 0.01, -0.01, 0.3, -0.3, 2.0, -2.0)
SEAMS_DEG = (90.0, -90.0, 0.0, 180.0, -180.0, 45.0, -45.0, 270.0)
ASPECTS = (1.0, 1.01, 1.02, 1.05, 1.1, 1.15, 1.2, 1.25, 1.3, 1.5)
ROUGHS_PX = (0.0, 0.2, 0.4)
ASPECT = "error at aspect 1.2"
ASPECT_ERROR_DEG = 2.0
"""Largest allowed error at aspect 1.2 for contours without errors."""


def _begin_axes(product: ProductFunctions) -> TrialFunction:
    def trial(rng: np.random.Generator, seed: int, results: FamilyResults) -> None:
        number, kind = divmod(seed, 3)
        if kind == 0:
            _check_elongated(number, rng, product, results)
        elif kind == 1:
            _check_axial_arithmetic(rng, results)
            _check_at_seam(number, rng, product, results)
        else:
            _check_nearly_round(number, rng, product, results)

    return trial


def _check_elongated(number: int, rng: np.random.Generator, product: ProductFunctions, results: FamilyResults) -> None:
    """Rotate, shift, scale and mirror a shape with a readable axis, with a contour error."""
    level = CONTOUR_ERRORS_PX[number % len(CONTOUR_ERRORS_PX)]
    shape = list(ELONGATED.values())[number // len(CONTOUR_ERRORS_PX) % len(ELONGATED)]
    mirrored = bool(rng.integers(2))
    a = ShapePose(rng.uniform(-180, 180), rng.uniform(50, 69), rng.uniform(65, 94), rng.uniform(0.7, 1.15), mirrored)
    rotation = float(rng.uniform(-90, 90))
    b = ShapePose(a.angle_deg + rotation, a.x_px + rng.uniform(-4, 4), a.y_px + rng.uniform(-4, 4), a.scale, mirrored)
    rough = roughness(rng, level), roughness(rng, level)
    maps = probability_map(shape, a, rough[0]), probability_map(shape, b, rough[1])
    if any(_cut_by_frame(one) for one in maps):  # the visible part has another axis
        return
    axes = estimate_axes_of_two(maps, product, results)
    if axes is not None:
        for estimator, one in check_axis_change(*axes, rotation, results).items():
            results.add_curve_point(f"outline/{estimator}", level, one)
    error = check_rotating_shape(shape, a, b, product, results, rough)
    results.add_curve_point("outline/pipeline", level, error)


def _cut_by_frame(probability: Map) -> bool:
    borders = (probability[0], probability[-1], probability[:, 0], probability[:, -1])
    return bool(max(border.max() for border in borders) > 0.1)


def _check_at_seam(number: int, rng: np.random.Generator, product: ProductFunctions, results: FamilyResults) -> None:
    """Check the axis of a symmetric shape at and next to ±90°, and rotations across."""
    shape = list(ALONG_U.values())[number % len(ALONG_U)]
    number //= len(ALONG_U)
    angle = SEAMS_DEG[number % len(SEAMS_DEG)] + OFFSETS_DEG[number // len(SEAMS_DEG) % len(OFFSETS_DEG)]
    center = (59.5, 79.5) if rng.random() < 0.5 else (rng.uniform(52, 67), rng.uniform(70, 89))
    at_seam = probability_map(shape, ShapePose(angle, *center))
    axes = estimate_axes_of_two((at_seam, at_seam), product, results)
    if axes is not None:
        for estimator, found in axes[0].items():
            results.check_angle(estimator, found.angle_deg, found.sigma_deg, angle, axial=True)
    rotation = float(rng.choice((-1.0, 1.0)) * rng.uniform(4, 24))
    across = ShapePose(angle - rotation / 2, *center), ShapePose(angle + rotation / 2, *center)
    check_rotating_shape(shape, *across, product, results)


def _check_axial_arithmetic(rng: np.random.Generator, results: FamilyResults) -> None:
    """Check axial arithmetic against IEEE remainders: on seams, at neighboring float64 values, for huge angles."""
    seam = float(rng.choice(SEAMS_DEG))
    value = float(rng.choice((seam, math.nextafter(seam, 1e9), math.nextafter(seam, -1e9), rng.normal(0, 1e3),
                              rng.normal(0, 1e9), 5e-324)))  # fmt: skip
    near = float(rng.normal(0, 1e4))
    wrapped = results.call("wrap", wrap_axial_deg, value)
    nearest = results.call("unwrap", nearest_rotation_deg, value, near)
    difference = results.call("difference", axial_difference_deg, value, near)
    for what, result in (("wrapped axis", wrapped), ("axial difference", difference)):
        if result is not None and results.check_finite(what, result) and not -90.0 < result <= 90.0:
            results.add_failure("limit", f"{what} of {value!r} is {result!r}, not in (-90, 90]")
    rounding = 1e-9 + 1e-13 * abs(value)
    for what, result in (("wrapped axis", wrapped), ("unwrapped rotation", nearest)):
        if result is not None and math.isfinite(result):
            error = abs(math.remainder(result - value, 180.0)) / rounding
            results.check_limit(f"{what}, error in units of rounding", error, 100.0)
    if nearest is not None and math.isfinite(nearest) and abs(nearest - near) > 90.0 + rounding:
        results.add_failure("limit", f"the rotation of {value!r} nearest to {near!r} is {nearest!r}")


def _check_nearly_round(
    number: int, rng: np.random.Generator, product: ProductFunctions, results: FamilyResults
) -> None:
    """Rotate an ellipse near a circle, a polygon, a disc or a ring, some of them cut by the frame."""
    number, choice = divmod(number, len(ASPECTS) + 3)
    rough_px = ROUGHS_PX[number % len(ROUGHS_PX)]
    shape, has_axis = _nearly_round(choice, rng)
    rotation = float(rng.uniform(-20, 20))
    out = 1.0 if has_axis or rng.random() < 0.5 else float(rng.uniform(1.0, 4.0))
    x, y = 59.5 + out * rng.uniform(-14, 14), 79.5 + out * rng.uniform(-14, 14)
    a = ShapePose(float(rng.uniform(-180, 180)), x, y, float(rng.uniform(0.7, 1.2)))
    b = ShapePose(a.angle_deg + rotation, x + rng.uniform(-2, 2), y + rng.uniform(-2, 2), a.scale)
    rough = roughness(rng, rough_px), roughness(rng, rough_px)
    maps = probability_map(shape, a, rough[0]), probability_map(shape, b, rough[1])
    axes = estimate_axes_of_two(maps, product, results)
    errors: dict[str, float | None] = {}
    if axes is not None:
        errors = check_axis_change(*axes, rotation if has_axis else None, results)
    if has_axis:
        errors["pipeline"] = check_rotating_shape(shape, a, b, product, results, rough)
    else:
        flickering = ((probability_map(shape, a, roughness(rng, rough_px)), None) for _ in range(4))
        check_sequence(ScriptedPipeline(product), flickering, results)
    if choice < len(ASPECTS):
        for estimator, error in errors.items():
            results.add_curve_point(f"aspect, outline {rough_px:g} px/{estimator}", ASPECTS[choice], error)
            if ASPECTS[choice] == 1.2 and rough_px == 0.0 and error is not None:
                results.check_limit(ASPECT, error, ASPECT_ERROR_DEG)


def _nearly_round(choice: int, rng: np.random.Generator) -> tuple[shapes.Distance, bool]:
    """Return a shape, and whether its axis shows its rotation."""
    if choice < len(ASPECTS):
        return shapes.round_of(ASPECTS[choice]), ASPECTS[choice] > 1.0
    corners, wide = int(rng.integers(3, 13)), float(rng.uniform(2, 9))
    return (shapes.polygon(corners), shapes.DISC, shapes.ring(26.0, wide))[choice - len(ASPECTS)], False


AXES = TrialFamily(
    "axes", "the axis of a drawn mask by four estimators: rotated, rough, at ±90°, nearly round", 20_000, 11.0,
    _begin_axes, min_answered_share=0.5,
)  # fmt: skip
