"""Trial family over the effects of real contacts, swept until estimates break: where they do is reported.

An estimate breaks if its error is more than four of its sigmas, however small it is in degrees.
"""

from __future__ import annotations

import numpy as np

from slipguard.datasets.effect_scenes import EFFECTS, EffectName, effect_cases, render_effect
from slipguard.perception.settings import PerceptionSettings
from slipguard.stress.product_functions import ProductFunctions
from slipguard.stress.trial_family import FamilyResults, TrialFamily, TrialFunction

LEVELS: dict[EffectName, tuple[float, ...]] = {
    "clean": (1.0,),
    "rocking": (1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 10.0, 12.0),
    "memory": (0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.8),
    "partial slip": (1.0, 2.0, 3.0, 5.0, 7.0, 9.0, 13.0, 17.0),
    "periodic": (300.0, 1_000.0, 3_000.0, 7_500.0, 12_000.0, 20_000.0, 30_000.0, 50_000.0),
}
"""Sizes of the effects, as in `effect_scenes.LEVELS`, and beyond."""
BROKEN_SIGMAS = 4.0


def _begin_effects(product: ProductFunctions) -> TrialFunction:
    segmenter = product.segmenter()

    def trial(rng: np.random.Generator, seed: int, results: FamilyResults) -> None:
        effect = EFFECTS[seed % len(EFFECTS)]
        levels, cases = LEVELS[effect], effect_cases(effect)
        number = seed // len(EFFECTS)
        level, case = levels[number % len(levels)], cases[int(rng.integers(len(cases)))]
        grasp = render_effect(effect, case, seed, level)
        sensor = (grasp.background, grasp.noise_bgr, grasp.px_per_mm)
        pipeline = product.pipeline(segmenter, PerceptionSettings(), *sensor)
        for shot in grasp.shots:
            estimate = results.call("pipeline", pipeline.process, shot.frame)
            if estimate is None or not shot.compared:
                continue
            rotation_deg, sigma_deg = estimate.rotation_deg, estimate.sigma_deg
            if rotation_deg is None or sigma_deg is None:
                results.declined += 1
                results.add_curve_point(f"{effect}/pipeline", level, None)
                continue
            results.estimated += 1
            if not results.check_finite("pipeline", rotation_deg, sigma_deg, *(estimate.shift_mm or ())):
                continue
            error = abs(rotation_deg - shot.rotation_deg)
            results.add_curve_point(f"{effect}/pipeline", level, error)
            results.worst_deg[effect] = max(results.worst_deg.get(effect, 0.0), error)
            results.worst_sigmas[effect] = max(results.worst_sigmas.get(effect, 0.0), error / sigma_deg)
            if error > BROKEN_SIGMAS * sigma_deg:
                results.broken_at[effect] = min(results.broken_at.get(effect, level), level)

    return trial


EFFECT_SWEEPS = TrialFamily(
    "effects", "rocking, gel memory, partial slip and periodic texture, each swept beyond its range", 4_000, 350.0,
    _begin_effects, 40, min_answered_share=0.4,
)  # fmt: skip
