"""Trial families on numbers: floating-point limits, finger fusion and irregular time stamps."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.perception.estimate import Estimate
from slipguard.perception.rotation.fusion import RotationEstimate
from slipguard.stress.map_checks import (
    Map,
    check_axis_change,
    check_registration_with_itself,
    check_sequence,
    estimate_axes,
    find_checked_patch,
)
from slipguard.stress.product_functions import FRAME_S, ProductFunctions, ScriptedPipeline
from slipguard.stress.shapes import ELONGATED, ShapePose, box, probability_map
from slipguard.stress.trial_family import FamilyResults, TrialFamily, TrialFunction

PRECISION_DEG = 0.01
"""Largest allowed difference of an axis between single and double precision."""
BAD_PROBABILITIES = (math.nan, math.inf, -math.inf, 3e38, -3e38, 1e-40, -1e-40, -0.0)
BAD_SHARES = (0.0005, 0.01, 0.1, 0.5, 1.0)
ODD_NUMBERS = (math.nan, math.inf, -math.inf, 1e308, -1e308, 5e-324, 0.0, -0.0, 1e-300, 1e18, -1e18)
STEPS_S = (0.0, 1e-12, 1e-9, 1e-6, 1e-3, FRAME_S, 0.1, 0.25, 1.0, 60.0, 1e6, 1e12, -1e-9, -FRAME_S, -1.0, -1e6)
INVALID_TIMES_S = (math.nan, math.inf, -math.inf)
RATE_DEG_S = 60.0
RATE_ERROR_DEG_S = 12.0
"""Largest allowed error of the rate. A noise of 0.1 degrees over a tenth of a second gives 1.5 degrees/s."""
REST_RATE_DEG_S = 400.0
"""Largest rate that a noise of 0.1 degrees gives over the shortest time step that counts."""
REGULAR_FRAMES = 30
NOISE_DEG = 0.1


def _begin_floats(product: ProductFunctions) -> TrialFunction:
    names = tuple(ELONGATED)

    def trial(rng: np.random.Generator, seed: int, results: FamilyResults) -> None:
        shape = ELONGATED[names[seed % len(names)]]
        pose = ShapePose(rng.uniform(-180, 180), rng.uniform(54, 65), rng.uniform(72, 87), rng.uniform(0.8, 1.1))
        clean = probability_map(shape, pose)
        _check_precision(clean, product, results)
        bad_value = BAD_PROBABILITIES[seed // len(names) % len(BAD_PROBABILITIES)]
        share = BAD_SHARES[seed // (len(names) * len(BAD_PROBABILITIES)) % len(BAD_SHARES)]
        bad = clean.copy()
        bad[rng.random(clean.shape) < share] = bad_value
        _check_bad_pixels(clean, bad, product, results)
        tiny = clean * np.float32(10.0 ** rng.uniform(-45, -1))
        huge = clean * np.float32(10.0 ** rng.uniform(1, 38))
        for scaled in (tiny, huge):
            patch = find_checked_patch(scaled, 1.0, product, results)
            if patch is not None:
                estimate_axes(patch, product, results)
                check_registration_with_itself(patch, product, results)

    return trial


def _check_precision(probability: Map, product: ProductFunctions, results: FamilyResults) -> None:
    """Check the axes against the same axes computed in float64 by other methods."""
    patch = find_checked_patch(probability, 100.0, product, results)
    if patch is None or patch.clipped.any:
        return
    axes = estimate_axes(patch, product, results)
    references = {
        "moments": second_moments_deg(patch.probability),
        "pca": second_moments_deg(patch.mask),
        "ellipse": fitted_ellipse_deg(patch.mask),
    }
    for name, reference in references.items():
        angle = axes[name].angle_deg if name in axes else None
        if angle is not None:
            difference = abs(math.remainder(angle - reference, 180.0))
            results.check_limit(f"{name}, float32 to float64", difference, PRECISION_DEG)


def second_moments_deg(weights: NDArray[np.float32] | NDArray[np.uint8]) -> float:
    """Return the long axis of the second moments, in float64."""
    y, x = np.nonzero(weights)
    w = weights[y, x].astype(np.float64)
    points = np.stack([x, -y], axis=1).astype(np.float64)
    points -= (w @ points) / w.sum()
    _, axes = np.linalg.eigh((points * w[:, None]).T @ points)
    return math.degrees(math.atan2(axes[1, 1], axes[0, 1]))


def fitted_ellipse_deg(mask: NDArray[np.uint8]) -> float:
    """Return the long axis of the ellipse fitted to the contour, in float64.

    Source: R. Halir, J. Flusser, "Numerically stable direct least squares fitting of ellipses", WSCG 1998.
    """
    contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    points = np.concatenate(contours)[:, 0].astype(np.float64)
    centered = points - points.mean(axis=0)
    x, y = (centered / np.abs(centered).max()).T
    square = np.stack([x * x, x * y, y * y], axis=1)
    plain = np.stack([x, y, np.ones_like(x)], axis=1)
    s1, s2, s3 = square.T @ square, square.T @ plain, plain.T @ plain
    m = s1 - s2 @ np.linalg.solve(s3, s2.T)
    _, vectors = np.linalg.eig(np.array([m[2] / 2.0, -m[1], m[0] / 2.0]))
    conic = np.real(vectors)
    inside = 4.0 * conic[0] * conic[2] - conic[1] ** 2
    a, b, c = conic[:, int(np.argmax(inside))]
    # The long axis is the direction of slowest growth of a x^2 + b x y + c y^2.
    _, axes = np.linalg.eigh(math.copysign(1.0, a) * np.array([[a, b / 2.0], [b / 2.0, c]]))
    return math.degrees(math.atan2(-axes[1, 0], axes[0, 0]))


def _check_bad_pixels(clean: Map, bad: Map, product: ProductFunctions, results: FamilyResults) -> None:
    """Check that bad pixels either change nothing or are detected: no NaN, no confident rotation."""
    before = find_checked_patch(clean, 100.0, product, results)
    now = find_checked_patch(bad, 100.0, product, results)
    if before is not None and now is not None:
        axes = estimate_axes(before, product, results), estimate_axes(now, product, results)
        check_axis_change(*axes, 0.0, results)
        check_registration_with_itself(now, product, results)
    check_sequence(ScriptedPipeline(product), ((shown, 0.0) for shown in (clean, bad, clean)), results)


def _finger_estimate(
    rotation_deg: float | None, sigma_deg: float | None, rate_deg_s: float | None, at_s: float
) -> Estimate:
    return Estimate(
        1, at_s, at_s, True, 4000, "fused", rotation_deg=rotation_deg, sigma_deg=sigma_deg, rate_deg_s=rate_deg_s,
        shift_mm=(0.1, -0.2),
    )  # fmt: skip


def _begin_fusion(product: ProductFunctions) -> TrialFunction:
    def trial(rng: np.random.Generator, seed: int, results: FamilyResults) -> None:
        rotation = float(rng.uniform(-120, 120))
        rate = float(rng.choice((0.0, 30.0, 300.0))) * float(rng.choice((-1.0, 1.0)))
        now_s = float(10.0 ** rng.uniform(-3, 9))
        pair: list[Estimate | None] = []
        for sign in (1.0, -1.0):
            age_s = float(rng.choice((0.0, 0.017, 0.05, 0.09, 3.0)))
            sigma = float(10.0 ** rng.uniform(-2, 1))
            angle = rotation - rate * age_s + sigma * float(rng.normal())
            estimated_rate = rate + float(rng.normal()) * 5.0
            known_rate = sign * estimated_rate if rng.random() < 0.8 else None
            one = _finger_estimate(sign * angle, sigma, known_rate, now_s - age_s)
            pair.append(None if rng.random() < 0.1 else one)
        fused = results.call("fusion", product.fuse, *pair)
        if fused is not None and fused.rotation_deg is not None:
            truth = rotation - rate * (now_s - fused.captured_at_s)
            results.check_angle("fusion", fused.rotation_deg, fused.sigma_deg, truth, axial=False)
        _check_odd_number(rng, pair, product, results)

    return trial


def _check_odd_number(
    rng: np.random.Generator, pair: list[Estimate | None], product: ProductFunctions, results: FamilyResults
) -> None:
    """Put an odd number into one field of one finger; the fused values must be finite and sigma positive."""
    which = int(rng.integers(2))
    one = pair[which] or _finger_estimate(1.0, 1.0, 0.0, 1.0)
    odd = ODD_NUMBERS[int(rng.integers(len(ODD_NUMBERS)))]
    field = ("rotation_deg", "sigma_deg", "rate_deg_s", "shift_mm", "captured_at_s", "measured_at_s")[
        int(rng.integers(6))
    ]
    value: Any = (0.0, odd) if field == "shift_mm" else odd
    broken = list(pair)
    broken[which] = replace(one, **{field: value})
    label = f"fusion with {field} {odd:g}"
    fused = results.call(label, product.fuse, *broken)
    if fused is None:
        return
    numbers = (fused.rotation_deg, fused.sigma_deg, fused.rate_deg_s, fused.shift_mm)
    finite = results.check_finite(label, *numbers, fused.captured_at_s, fused.measured_at_s)
    if finite and fused.sigma_deg is not None and fused.sigma_deg <= 0.0:
        results.add_failure("limit", f"{label}: sigma is {fused.sigma_deg:g}°")


def _begin_times(product: ProductFunctions) -> TrialFunction:
    bar = probability_map(box(34, 9), ShapePose(20.0))

    def trial(rng: np.random.Generator, seed: int, results: FamilyResults) -> None:
        _check_tracker(rng, product, results)
        if seed % 10 == 0:
            pipeline = ScriptedPipeline(product)
            now_s = float(10.0 ** rng.uniform(0, 9))
            for _ in range(12):
                step_s = float(rng.choice(STEPS_S))
                invalid = rng.random() < 0.15
                frame_s = float(rng.choice(INVALID_TIMES_S)) if invalid else now_s + step_s
                estimate = results.call("pipeline", pipeline.process_at, frame_s, bar)
                if not invalid:
                    now_s += step_s
                if estimate is not None:
                    results.check_finite("pipeline", estimate.captured_at_s, estimate.measured_at_s)
                    results.check_rotation("pipeline", estimate, 0.0)

    return trial


def _check_tracker(rng: np.random.Generator, product: ProductFunctions, results: FamilyResults) -> None:
    """Track an object at rest over odd time steps, then a steady rotation: its rate must be found again."""
    tracker = product.tracker()
    now_s = float(10.0 ** rng.uniform(0, 6))
    tracker.start(now_s)
    for _ in range(20):
        now_s += float(rng.choice(STEPS_S))
        noisy = RotationEstimate(float(rng.normal()) * NOISE_DEG, NOISE_DEG)
        predicted = results.call("prediction", tracker.predicted_deg, now_s)
        accepted = results.call("tracker", tracker.accept, now_s, noisy)
        rate = results.call("rate", tracker.rate_deg_s, now_s)
        results.check_finite("prediction", predicted)
        if rate is not None:
            results.check_limit("rate at rest, degrees/s", abs(rate), REST_RATE_DEG_S)
        if accepted is not None:
            results.check_angle("tracker", accepted.rotation_deg, accepted.sigma_deg, 0.0, axial=False)
    if abs(now_s) > 1e9:  # float64 cannot resolve frames at 60 Hz here, so that no rate can be right
        return
    rate = None
    for k in range(REGULAR_FRAMES):
        now_s += FRAME_S
        noisy = RotationEstimate(RATE_DEG_S * FRAME_S * k + float(rng.normal()) * NOISE_DEG, NOISE_DEG)
        results.call("tracker", tracker.accept, now_s, noisy)
        rate = results.call("rate", tracker.rate_deg_s, now_s)
    error = math.inf if rate is None else abs(rate - RATE_DEG_S)
    if math.isfinite(error):
        results.check_limit("rate after odd times, error in degrees/s", error, RATE_ERROR_DEG_S)
    else:
        results.add_failure("limit", f"half a second after odd times the rate is still {rate}")


FLOATS = TrialFamily(
    "floats", "float32 to float64, denormal, huge, NaN and infinite probabilities", 4_800, 13.0, _begin_floats,
    min_answered_share=0.65,
)  # fmt: skip
FUSION = TrialFamily(
    "fusion", "two fingers with missing, odd, stale and contradicting estimates", 200_000, 0.18, _begin_fusion,
    min_answered_share=0.9,
)  # fmt: skip
TIMES = TrialFamily(
    "times", "missing time stamps, and clocks that leap, stop or run backwards", 50_000, 1.8, _begin_times,
    min_answered_share=0.98,
)  # fmt: skip
