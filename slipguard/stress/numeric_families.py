"""Trial families on numbers: floating-point limits, finger fusion and irregular time stamps."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.perception.estimate import Estimate
from slipguard.perception.rotation.tracker import RotationEstimate
from slipguard.stress.map_checks import Map, check_laid_over_itself, compare, patch_of, read
from slipguard.stress.product_functions import FRAME_S, MAP_PX, ProductFunctions, ScriptedPipeline
from slipguard.stress.shapes import ELONGATED, ShapePose, box, soft
from slipguard.stress.trial_family import FamilyResults, TrialFamily, TrialFunction

PRECISION_DEG = 0.01
"""What single precision may change in an axis."""
POISONS = (math.nan, math.inf, -math.inf, 3e38, -3e38, 1e-40, -1e-40, -0.0)
SHARES = (0.0005, 0.01, 0.1, 0.5, 1.0)


def _begin_floats(product: ProductFunctions) -> TrialFunction:
    names = tuple(ELONGATED)

    def trial(rng: np.random.Generator, seed: int, results: FamilyResults) -> None:
        shape = ELONGATED[names[seed % len(names)]]
        pose = ShapePose(rng.uniform(-180, 180), rng.uniform(54, 65), rng.uniform(72, 87), rng.uniform(0.8, 1.1))
        clean = soft(shape, pose)
        _check_precision(clean, product, results)
        poison = POISONS[seed // len(names) % len(POISONS)]
        share = SHARES[seed // (len(names) * len(POISONS)) % len(SHARES)]
        poisoned = clean.copy()
        poisoned[rng.random(clean.shape) < share] = poison
        _check_poisoned(clean, poisoned, product, results)
        tiny = clean * np.float32(10.0 ** rng.uniform(-45, -1))
        huge = clean * np.float32(10.0 ** rng.uniform(1, 38))
        for scaled in (tiny, huge):
            patch = patch_of(scaled, 1.0, MAP_PX, product, results)
            if patch is not None:
                read(patch, product, results)
                check_laid_over_itself(patch, product, results)

    return trial


def _check_precision(probability: Map, product: ProductFunctions, results: FamilyResults) -> None:
    """The same axes in float64, by other means."""
    patch = patch_of(probability, 100.0, MAP_PX, product, results)
    if patch is None or patch.clipped.any:
        return
    answers = read(patch, product, results)
    references = {
        "moments": second_moments_deg(patch.probability),
        "pca": second_moments_deg(patch.mask),
        "ellipse": fitted_ellipse_deg(patch.mask),
    }
    for name, reference in references.items():
        angle = answers[name].angle_deg if name in answers else None
        if angle is not None:
            results.check_limit(
                f"{name}, float32 to float64", abs(math.remainder(angle - reference, 180.0)), PRECISION_DEG
            )


def second_moments_deg(weights: NDArray[np.float32] | NDArray[np.uint8]) -> float:
    """The long axis of the second moments in float64, by the singular vectors of the weighted points."""
    y, x = np.nonzero(weights)
    w = weights[y, x].astype(np.float64)
    points = np.stack([x, -y], axis=1).astype(np.float64)
    points -= (w @ points) / w.sum()
    _, axes = np.linalg.eigh((points * w[:, None]).T @ points)
    return math.degrees(math.atan2(axes[1, 1], axes[0, 1]))


def fitted_ellipse_deg(mask: NDArray[np.uint8]) -> float:
    """The long axis of the ellipse through the outline in float64.

    R. Halir, J. Flusser, "Numerically stable direct least squares fitting of ellipses", WSCG 1998.
    """
    contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    points = np.concatenate(contours)[:, 0].astype(np.float64)
    centred = points - points.mean(axis=0)
    x, y = (centred / np.abs(centred).max()).T
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


def _check_poisoned(clean: Map, poisoned: Map, product: ProductFunctions, results: FamilyResults) -> None:
    """Poisoned pixels change nothing, or are noticed: no NaN out, no confident turn."""
    before = patch_of(clean, 100.0, MAP_PX, product, results)
    now = patch_of(poisoned, 100.0, MAP_PX, product, results)
    if before is not None and now is not None:
        compare(read(before, product, results), read(now, product, results), 0.0, results)
        check_laid_over_itself(now, product, results)
    finger = ScriptedPipeline(product)
    for shown in (clean, poisoned, clean):
        answer = results.call("pipeline", finger.see, shown)
        if answer is not None:
            results.check_finite("pipeline", answer.orientation_deg, answer.rate_deg_s, *(answer.shift_mm or ()))
            results.check_angle("pipeline", answer.angle_deg, answer.sigma_deg, 0.0, axial=False)


FLOATS = TrialFamily(
    "floats",
    "float32 to float64, denormal, huge, NaN and infinite probabilities",
    4_800,
    13.0,
    _begin_floats,
    min_answered_share=0.65,
)


ODD = (math.nan, math.inf, -math.inf, 1e308, -1e308, 5e-324, 0.0, -0.0, 1e-300, 1e18, -1e18)


def _finger_estimate(
    angle_deg: float | None, sigma_deg: float | None, rate_deg_s: float | None, at_s: float
) -> Estimate:
    return Estimate(
        1, at_s, at_s, True, 4000, "fused", angle_deg=angle_deg, sigma_deg=sigma_deg, rate_deg_s=rate_deg_s,
        shift_mm=(0.1, -0.2),
    )  # fmt: skip


def _begin_fusion(product: ProductFunctions) -> TrialFunction:
    def trial(rng: np.random.Generator, seed: int, results: FamilyResults) -> None:
        rotation = float(rng.uniform(-120, 120))
        rate = float(rng.choice((0.0, 30.0, 300.0))) * float(rng.choice((-1.0, 1.0)))
        now_s = float(10.0 ** rng.uniform(-3, 9))
        pair: list[Estimate | None] = []
        for sign in (1.0, -1.0):
            late_s = float(rng.choice((0.0, 0.017, 0.05, 0.09, 3.0)))
            sigma = float(10.0 ** rng.uniform(-2, 1))
            seen = rotation - rate * late_s + sigma * float(rng.normal())
            said = rate + float(rng.normal()) * 5.0
            one = _finger_estimate(sign * seen, sigma, sign * said if rng.random() < 0.8 else None, now_s - late_s)
            pair.append(None if rng.random() < 0.1 else one)
        fused = results.call("fusion", product.fuse, *pair)
        if fused is not None and fused.rotation_deg is not None:
            truth = rotation - rate * (now_s - fused.captured_at_s)
            results.check_angle("fusion", fused.rotation_deg, fused.sigma_deg, truth, axial=False)
        _check_odd(rng, pair, product, results)

    return trial


def _check_odd(
    rng: np.random.Generator, pair: list[Estimate | None], product: ProductFunctions, results: FamilyResults
) -> None:
    """One field of one finger is odd: what comes out is finite, and its sigma positive."""
    which = int(rng.integers(2))
    one = pair[which] or _finger_estimate(1.0, 1.0, 0.0, 1.0)
    odd = ODD[int(rng.integers(len(ODD)))]
    field = ("angle_deg", "sigma_deg", "rate_deg_s", "shift_mm", "captured_at_s", "measured_at_s")[int(rng.integers(6))]
    value: Any = (0.0, odd) if field == "shift_mm" else odd
    broken = list(pair)
    broken[which] = replace(one, **{field: value})
    said = f"fusion with {field} {odd:g}"
    fused = results.call(said, product.fuse, *broken)
    if fused is None:
        return
    out = (
        fused.rotation_deg,
        fused.sigma_deg,
        fused.rate_deg_s,
        fused.shift_mm,
        fused.captured_at_s,
        fused.measured_at_s,
    )
    if results.check_finite(said, *out) and fused.sigma_deg is not None and fused.sigma_deg <= 0.0:
        results.add_failure("limit", f"{said}: sigma is {fused.sigma_deg:g}°")


FUSION = TrialFamily(
    "fusion",
    "two fingers with missing, odd, stale and contradicting estimates",
    200_000,
    0.18,
    _begin_fusion,
    min_answered_share=0.9,
)


STEPS_S = (0.0, 1e-12, 1e-9, 1e-6, 1e-3, FRAME_S, 0.1, 0.25, 1.0, 60.0, 1e6, 1e12, -1e-9, -FRAME_S, -1.0, -1e6)
NO_TIMES = (math.nan, math.inf, -math.inf)
RATE_DEG_S = 60.0
RATE_SIGMA_DEG_S = 12.0
"""Noise of the rate at a noise of 0.1 degrees over a tenth of a second is 1.5 degrees/s; this is far outside."""
REST_RATE_DEG_S = 400.0
"""What a noise of 0.1 degrees may pretend over the shortest time that counts."""
REGULAR_FRAMES = 30
NOISE_DEG = 0.1


def _begin_times(product: ProductFunctions) -> TrialFunction:
    bar = soft(box(34, 9), ShapePose(20.0))

    def trial(rng: np.random.Generator, seed: int, results: FamilyResults) -> None:
        _track(rng, product, results)
        if seed % 10 == 0:
            finger = ScriptedPipeline(product)
            when_s = float(10.0 ** rng.uniform(0, 9))
            for _ in range(12):
                step = float(rng.choice(STEPS_S))
                odd = rng.random() < 0.15
                answer = results.call(
                    "pipeline", finger.see, bar, float(rng.choice(NO_TIMES)) if odd else when_s + step
                )
                if not odd:
                    when_s += step
                if answer is not None:
                    results.check_finite("pipeline", answer.rate_deg_s, answer.captured_at_s, answer.measured_at_s)
                    results.check_angle("pipeline", answer.angle_deg, answer.sigma_deg, 0.0, axial=False)

    return trial


def _track(rng: np.random.Generator, product: ProductFunctions, results: FamilyResults) -> None:
    """Odd steps with the object at rest, then regular frames of a steady turn: the rate must find back to it."""
    tracker = product.tracker()
    now_s = float(10.0 ** rng.uniform(0, 6))
    tracker.start(now_s)
    for _ in range(20):
        now_s += float(rng.choice(STEPS_S))
        seen = RotationEstimate(float(rng.normal()) * NOISE_DEG, NOISE_DEG)
        predicted = results.call("prediction", tracker.predicted_deg, now_s)
        accepted = results.call("tracker", tracker.accept, now_s, seen)
        rate = results.call("rate", tracker.rate_deg_s, now_s)
        results.check_finite("prediction", predicted)
        if rate is not None:
            results.check_limit("rate at rest, degrees/s", abs(rate), REST_RATE_DEG_S)
        if accepted is not None:
            results.check_angle("tracker", accepted.rotation_deg, accepted.sigma_deg, 0.0, axial=False)
    if abs(now_s) > 1e9:  # a double tells no 60 Hz frames apart beyond: no rate can be right
        return
    rate = None
    for k in range(REGULAR_FRAMES):
        now_s += FRAME_S
        seen = RotationEstimate(RATE_DEG_S * FRAME_S * k + float(rng.normal()) * NOISE_DEG, NOISE_DEG)
        results.call("tracker", tracker.accept, now_s, seen)
        rate = results.call("rate", tracker.rate_deg_s, now_s)
    wrong = math.inf if rate is None else abs(rate - RATE_DEG_S)
    if math.isfinite(wrong):
        results.check_limit("rate after odd times, error in degrees/s", wrong, RATE_SIGMA_DEG_S)
    else:
        results.add_failure("limit", f"half a second after odd times the rate is still {rate}")


TIMES = TrialFamily(
    "times",
    "frames without time, with leaping, standing and backward clocks",
    50_000,
    1.8,
    _begin_times,
    min_answered_share=0.98,
)
