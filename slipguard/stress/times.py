"""Clocks that stand still, leap, run backwards or are no numbers: the tracker and the pipeline live through them."""

from __future__ import annotations

import math

import numpy as np

from slipguard.perception.rotation.tracker import RotationEstimate
from slipguard.stress.family import FamilyResults, TrialFamily, TrialFunction
from slipguard.stress.product_functions import FRAME_S, ProductFunctions, ScriptedPipeline
from slipguard.stress.shapes import ShapePose, box, soft

STEPS_S = (0.0, 1e-12, 1e-9, 1e-6, 1e-3, FRAME_S, 0.1, 0.25, 1.0, 60.0, 1e6, 1e12, -1e-9, -FRAME_S, -1.0, -1e6)
NO_TIMES = (math.nan, math.inf, -math.inf)
RATE_DEG_S = 60.0
RATE_SIGMA_DEG_S = 12.0
"""Noise of the rate at a noise of 0.1 degrees over a tenth of a second is 1.5 degrees/s; this is far outside."""
REST_RATE_DEG_S = 400.0
"""What a noise of 0.1 degrees may pretend over the shortest time that counts."""
REGULAR_FRAMES = 30
NOISE_DEG = 0.1


def _begin(product: ProductFunctions) -> TrialFunction:
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
    _begin,
    min_answered_share=0.98,
)
