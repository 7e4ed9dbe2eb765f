"""Trial families on drawn shapes: equivariance, noise, axes near ±90°, and nearly round contacts."""

from __future__ import annotations

import math

import numpy as np

from slipguard.perception.rotation.axial_angle import (
    axial_difference_deg,
    axial_mean_deg,
    nearest_rotation_deg,
    wrap_axial_deg,
)
from slipguard.stress import shapes
from slipguard.stress.map_checks import (
    Map,
    check_axis_change,
    check_sequence,
    estimate_axes,
    estimate_axes_of_two,
    find_checked_patch,
)
from slipguard.stress.product_functions import ProductFunctions, ScriptedPipeline
from slipguard.stress.shapes import (
    ALONG_U,
    ELONGATED,
    LONG_BAR,
    ShapePose,
    check_rotating_shape,
    probability_map,
    roughness,
)
from slipguard.stress.trial_family import FamilyResults, TrialFamily, TrialFunction

CONTOUR_ERRORS_PX = (0.0, 0.1, 0.2, 0.3, 0.5, 0.7, 1.0, 1.5, 2.0, 3.0)
"""Standard deviations of the contour's position in network pixels; that of the shipped network is about 0.3."""
PROBABILITY_NOISES = (0.05, 0.1, 0.2, 0.3, 0.4, 0.5)
"""Standard deviations of white noise on the probability."""
OFFSETS_DEG = (0.0, 1e-12, -1e-12, 1e-6, -1e-6, 0.01, -0.01, 0.3, -0.3, 2.0, -2.0)
SEAMS_DEG = (90.0, -90.0, 0.0, 180.0, -180.0, 45.0, -45.0, 270.0)
ASPECTS = (1.0, 1.01, 1.02, 1.05, 1.1, 1.15, 1.2, 1.25, 1.3, 1.5)
ROUGHS_PX = (0.0, 0.2, 0.4)
ASPECT = "error at aspect 1.2"
ASPECT_ERROR_DEG = 2.0
"""Largest allowed error at aspect 1.2 for contours without errors."""


def _cut_by_frame(probability: Map) -> bool:
    borders = (probability[0], probability[-1], probability[:, 0], probability[:, -1])
    return bool(max(border.max() for border in borders) > 0.1)


def _begin_equivariance(product: ProductFunctions) -> TrialFunction:
    names = (*ELONGATED, "long bar")

    def trial(rng: np.random.Generator, seed: int, results: FamilyResults) -> None:
        name = names[seed % len(names)]
        shape = LONG_BAR if name == "long bar" else ELONGATED[name]
        spread = 45.0 if seed % 4 == 3 else 12.0
        mirrored = bool(rng.integers(2))

        def pose_at(angle_deg: float) -> ShapePose:
            x, y = 59.5 + rng.uniform(-1, 1) * spread, 79.5 + rng.uniform(-1, 1) * spread
            return ShapePose(angle_deg, x, y, rng.uniform(0.6, 1.2), mirrored)

        a = pose_at(rng.uniform(-180, 180))
        rotation = float(rng.uniform(-90, 90))
        b = pose_at(a.angle_deg + rotation)
        maps = probability_map(shape, a), probability_map(shape, b)
        # If the frame cuts a shape that is not symmetric, the visible part has another axis.
        whole = name in ALONG_U or name == "long bar" or not any(_cut_by_frame(one) for one in maps)
        axes = estimate_axes_of_two(maps, product, results) if whole else None
        if axes is not None:
            check_axis_change(*axes, rotation, results)
            if name in ALONG_U:
                for estimator, found in axes[1].items():
                    label = f"{estimator}, absolute"
                    results.check_angle(label, found.angle_deg, found.sigma_deg, b.angle_deg, axial=True)
        rotation = float(rng.uniform(-25, 25))
        near = ShapePose(a.angle_deg + rotation, a.x_px + rng.uniform(-8, 8), a.y_px + rng.uniform(-8, 8),
                         a.scale * rng.uniform(0.95, 1.1), mirrored)  # fmt: skip
        check_rotating_shape(shape, a, near, product, results)

    return trial


def _begin_noise(product: ProductFunctions) -> TrialFunction:
    levels = [("outline", level) for level in CONTOUR_ERRORS_PX] + [("gray", level) for level in PROBABILITY_NOISES]
    names = tuple(ELONGATED)

    def trial(rng: np.random.Generator, seed: int, results: FamilyResults) -> None:
        curve, level = levels[seed % len(levels)]
        shape = ELONGATED[names[seed // len(levels) % len(names)]]
        a = ShapePose(rng.uniform(-180, 180), rng.uniform(50, 69), rng.uniform(65, 94), rng.uniform(0.8, 1.15))
        rotation = float(rng.uniform(-20, 20))
        b = ShapePose(a.angle_deg + rotation, a.x_px + rng.uniform(-4, 4), a.y_px + rng.uniform(-4, 4), a.scale)
        if curve == "outline":
            rough = roughness(rng, level), roughness(rng, level)
            maps = probability_map(shape, a, rough[0]), probability_map(shape, b, rough[1])
            error = check_rotating_shape(shape, a, b, product, results, rough)
        else:
            maps = (
                _with_noise(probability_map(shape, a), level, rng),
                _with_noise(probability_map(shape, b), level, rng),
            )
            error = check_sequence(ScriptedPipeline(product), zip(maps, (0.0, rotation), strict=True), results)
        results.add_curve_point(f"{curve}/pipeline", level, error)
        axes = estimate_axes_of_two(maps, product, results)
        if axes is not None:
            for estimator, one in check_axis_change(*axes, rotation, results).items():
                results.add_curve_point(f"{curve}/{estimator}", level, one)

    return trial


def _with_noise(probability: Map, sigma: float, rng: np.random.Generator) -> Map:
    noise = np.float32(sigma) * rng.standard_normal(probability.shape, dtype=np.float32)
    return np.clip(probability + noise, 0.0, 1.0).astype(np.float32)


def _begin_seams(product: ProductFunctions) -> TrialFunction:
    names = tuple(ALONG_U)

    def trial(rng: np.random.Generator, seed: int, results: FamilyResults) -> None:
        _check_axial_arithmetic(rng, results)
        shape = ALONG_U[names[seed % len(names)]]
        seam = SEAMS_DEG[seed // len(names) % len(SEAMS_DEG)]
        angle = seam + OFFSETS_DEG[seed // (len(names) * len(SEAMS_DEG)) % len(OFFSETS_DEG)]
        center = (59.5, 79.5) if rng.random() < 0.5 else (rng.uniform(52, 67), rng.uniform(70, 89))
        patch = find_checked_patch(probability_map(shape, ShapePose(angle, *center)), 100.0, product, results)
        if patch is not None:
            for estimator, found in estimate_axes(patch, product, results).items():
                results.check_angle(estimator, found.angle_deg, found.sigma_deg, angle, axial=True)
        rotation = float(rng.choice((-1.0, 1.0)) * rng.uniform(4, 24))
        across = ShapePose(angle - rotation / 2, *center), ShapePose(angle + rotation / 2, *center)
        check_rotating_shape(shape, *across, product, results)

    return trial


def _check_axial_arithmetic(rng: np.random.Generator, results: FamilyResults) -> None:
    """Check axial arithmetic against IEEE remainders: on seams, at neighboring float64 values, for huge angles."""
    seam = float(rng.choice(SEAMS_DEG))
    value = float(rng.choice((seam, math.nextafter(seam, 1e9), math.nextafter(seam, -1e9), rng.normal(0, 1e3),
                              rng.normal(0, 1e9), 5e-324)))  # fmt: skip
    near = float(rng.normal(0, 1e4))
    wrapped = results.call("wrap", wrap_axial_deg, value)
    nearest = results.call("unwrap", nearest_rotation_deg, value, near)
    difference = results.call("difference", axial_difference_deg, value, near)
    mean = results.call("mean", axial_mean_deg, [value, value + 180.0, value - 180.0], [1.0, 2.0, 3.0])
    for what, result in (("wrapped axis", wrapped), ("axial difference", difference), ("axial mean", mean)):
        if result is not None and results.check_finite(what, result) and not -90.0 < result <= 90.0:
            results.add_failure("limit", f"{what} of {value!r} is {result!r}, not in (-90, 90]")
    rounding = 1e-9 + 1e-13 * abs(value)
    for what, result in (("wrapped axis", wrapped), ("unwrapped rotation", nearest), ("axial mean", mean)):
        if result is not None and math.isfinite(result):
            error = abs(math.remainder(result - value, 180.0)) / rounding
            results.check_limit(f"{what}, error in units of rounding", error, 100.0)
    if nearest is not None and math.isfinite(nearest) and abs(nearest - near) > 90.0 + rounding:
        results.add_failure("limit", f"the rotation of {value!r} nearest to {near!r} is {nearest!r}")


def _begin_round(product: ProductFunctions) -> TrialFunction:
    def trial(rng: np.random.Generator, seed: int, results: FamilyResults) -> None:
        seed, choice = divmod(seed, len(ASPECTS) + 4)
        rough_px = ROUGHS_PX[seed % len(ROUGHS_PX)]
        shape, visible = _nearly_round(choice, rng)
        rotation = float(rng.uniform(-20, 20))
        out = 1.0 if choice < len(ASPECTS) or rng.random() < 0.5 else float(rng.uniform(1.0, 4.0))
        x, y = 59.5 + out * rng.uniform(-14, 14), 79.5 + out * rng.uniform(-14, 14)
        a = ShapePose(float(rng.uniform(-180, 180)), x, y, float(rng.uniform(0.7, 1.2)))
        b = ShapePose(a.angle_deg + rotation, x + rng.uniform(-2, 2), y + rng.uniform(-2, 2), a.scale)
        rough = roughness(rng, rough_px), roughness(rng, rough_px)
        maps = probability_map(shape, a, rough[0]), probability_map(shape, b, rough[1])
        axes = estimate_axes_of_two(maps, product, results)
        errors: dict[str, float | None] = {}
        if axes is not None:
            errors = check_axis_change(*axes, rotation if visible == "axis" else None, results)
        if visible == "nothing":
            flickering = ((probability_map(shape, a, roughness(rng, rough_px)), None) for _ in range(4))
            check_sequence(ScriptedPipeline(product), flickering, results)
        else:
            errors["pipeline"] = check_rotating_shape(shape, a, b, product, results, rough)
        if choice < len(ASPECTS):
            for estimator, error in errors.items():
                results.add_curve_point(f"aspect, outline {rough_px:g} px/{estimator}", ASPECTS[choice], error)
                if ASPECTS[choice] == 1.2 and rough_px == 0.0 and error is not None:
                    results.check_limit(ASPECT, error, ASPECT_ERROR_DEG)

    return trial


def _nearly_round(choice: int, rng: np.random.Generator) -> tuple[shapes.Distance, str]:
    """Return a shape, and what shows its rotation: "axis", "contour" or "nothing"."""
    if choice < len(ASPECTS):
        aspect = ASPECTS[choice]
        return shapes.round_of(aspect), "nothing" if aspect == 1.0 else "axis"
    corners = int(rng.integers(3, 13))
    wide = float(rng.uniform(2, 9))
    return (
        (shapes.polygon(corners), "contour"),
        (shapes.DISC, "nothing"),
        (shapes.ring(26.0, wide), "nothing"),
        (shapes.box(22, 22), "contour"),
    )[choice - len(ASPECTS)]


EQUIVARIANCE = TrialFamily(
    "equivariance", "shapes rotated, shifted, scaled, mirrored, cut by the frame", 20_000, 11.0, _begin_equivariance,
    min_answered_share=0.85,
)  # fmt: skip
NOISE = TrialFamily(
    "noise", "contours and probabilities with growing noise", 12_000, 11.0, _begin_noise, min_answered_share=0.75
)
SEAMS = TrialFamily(
    "seams", "axes on and next to ±90°, rotations across", 5 * len(ALONG_U) * len(SEAMS_DEG) * len(OFFSETS_DEG), 10.0,
    _begin_seams, min_answered_share=0.9,
)  # fmt: skip
ROUND = TrialFamily(
    "round", "nearly round contacts, polygons, rings, discs at the edge", 8_400, 10.0, _begin_round,
    min_answered_share=0.18,
)  # fmt: skip
