"""Trial families on numbers: floating-point limits, finger fusion and irregular time stamps."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import cycle
from typing import Any

import numpy as np

from slipguard.perception.estimate import Estimate
from slipguard.perception.rotation_filter import Hypothesis
from slipguard.stress.map_checks import check_sequence, estimate_axes, find_checked_patch
from slipguard.stress.product_functions import FRAME_S, ProductFunctions, ScriptedPipeline
from slipguard.stress.shapes import ELONGATED, ShapePose, probability_map
from slipguard.stress.textured_surfaces import LEVEL, LedLights, contact_map, heights, lettered, shaded_image
from slipguard.stress.trial_family import FamilyResults, TrialFamily, TrialFunction

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
    background = np.full((320, 240, 3), round(LEVEL), np.uint8)

    def trial(rng: np.random.Generator, seed: int, results: FamilyResults) -> None:
        shape = ELONGATED[names[seed % len(names)]]
        pose = ShapePose(rng.uniform(-180, 180), rng.uniform(54, 65), rng.uniform(72, 87), rng.uniform(0.8, 1.1))
        clean = probability_map(shape, pose)
        bad_value = BAD_PROBABILITIES[seed // len(names) % len(BAD_PROBABILITIES)]
        share = BAD_SHARES[seed // (len(names) * len(BAD_PROBABILITIES)) % len(BAD_SHARES)]
        bad = clean.copy()
        bad[rng.random(clean.shape) < share] = bad_value
        tiny = clean * np.float32(10.0 ** rng.uniform(-45, -1))
        huge = clean * np.float32(10.0 ** rng.uniform(1, 38))
        for one in (bad, tiny, huge):
            patch = find_checked_patch(one, 1.0, product, results)
            if patch is not None:
                estimate_axes(patch, product, results)
        at_rest = [(one, 0.0) for one in (clean, bad, clean, huge, tiny, clean)]
        check_sequence(ScriptedPipeline(product), at_rest, results, "pipeline, mask")
        pressed = heights(lettered, pose.angle_deg, (2.0 * pose.x_px, 2.0 * pose.y_px), 1.0)
        images = cycle([shaded_image(pressed, LedLights(), 1.0, rng) for _ in range(2)])
        textured = ScriptedPipeline(product, background=background, every_map=True)
        check_sequence(textured, at_rest, results, "pipeline, texture", images)

    return trial


def _finger_estimate(
    rotation_deg: float | None, sigma_deg: float | None, rate_deg_s: float | None, at_s: float
) -> Estimate:
    return Estimate(
        1, at_s, at_s, True, 4000, "model", rotation_deg=rotation_deg, sigma_deg=sigma_deg, rate_deg_s=rate_deg_s,
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
    background, noise = np.full((320, 240, 3), round(LEVEL), np.uint8), np.random.default_rng(0)
    pressed = heights(lettered, 20.0, (119.5, 159.5), 1.0)
    images = cycle([shaded_image(pressed, LedLights(), 1.0, noise) for _ in range(4)])

    def trial(rng: np.random.Generator, seed: int, results: FamilyResults) -> None:
        _check_filter(rng, product, results)
        if seed % 10 == 0:
            pipeline = ScriptedPipeline(product, background=background)
            now_s = float(10.0 ** rng.uniform(0, 9))
            for _ in range(12):
                step_s = float(rng.choice(STEPS_S))
                invalid = rng.random() < 0.15
                frame_s = float(rng.choice(INVALID_TIMES_S)) if invalid else now_s + step_s
                estimate = results.call("pipeline", pipeline.process_at, frame_s, contact_map(pressed), next(images))
                if not invalid:
                    now_s += step_s
                if estimate is not None:
                    results.check_finite("pipeline", estimate.captured_at_s, estimate.measured_at_s)
                    results.check_rotation("pipeline", estimate, 0.0)

    return trial


def _check_filter(rng: np.random.Generator, product: ProductFunctions, results: FamilyResults) -> None:
    """Filter an object at rest over odd time steps, then a steady rotation: its rate must be found again."""
    rotations = product.rotations()
    now_s = float(10.0 ** rng.uniform(0, 6))
    rotations.start(now_s)

    def update(at_s: float, rotation_deg: float) -> None:
        noisy = Hypothesis(rotation_deg + float(rng.normal()) * NOISE_DEG, 0.0)
        found = results.call("filter", rotations.update, at_s, [noisy])
        if found is not None:
            sigma_deg = None if found.rotation_deg is None else NOISE_DEG
            results.check_angle("filter", found.rotation_deg, sigma_deg, rotation_deg, axial=False)

    for _ in range(20):
        now_s += float(rng.choice(STEPS_S))
        results.check_finite("prediction", results.call("prediction", rotations.predicted_deg, now_s))
        results.check_finite("reach", results.call("reach", rotations.reach_deg, now_s))
        update(now_s, 0.0)
        rate = results.call("rate", rotations.rate_deg_s, now_s)
        if rate is not None:
            results.check_limit("rate at rest, degrees/s", abs(rate), REST_RATE_DEG_S)
    if abs(now_s) > 1e9:  # float64 cannot resolve frames at 60 Hz here, so that no rate can be right
        return
    rate = None
    for k in range(REGULAR_FRAMES):
        now_s += FRAME_S
        update(now_s, RATE_DEG_S * FRAME_S * k)
        rate = results.call("rate", rotations.rate_deg_s, now_s)
    error = math.inf if rate is None else abs(rate - RATE_DEG_S)
    if math.isfinite(error):
        results.check_limit("rate after odd times, error in degrees/s", error, RATE_ERROR_DEG_S)
    else:
        results.add_failure("limit", f"half a second after odd times the rate is still {rate}")


FLOATS = TrialFamily(
    "floats", "denormal, huge, NaN and infinite probabilities through the whole pipeline", 4_800, 40.0, _begin_floats,
    min_answered_share=0.5,
)  # fmt: skip
FUSION = TrialFamily(
    "fusion", "two fingers with missing, odd, stale and contradicting estimates", 200_000, 0.18, _begin_fusion,
    min_answered_share=0.9,
)  # fmt: skip
TIMES = TrialFamily(
    "times", "missing time stamps, and clocks that leap, stop or run backwards", 50_000, 1.8, _begin_times,
    min_answered_share=0.98,
)  # fmt: skip
