"""Outlines that are wrong by more and more pixels, probabilities with more and more noise: errors against noise."""

from __future__ import annotations

import numpy as np

from slipguard.stress.family import FamilyResults, TrialFamily, TrialFunction
from slipguard.stress.map_checks import Map, compare
from slipguard.stress.product_functions import ProductFunctions, ScriptedPipeline
from slipguard.stress.rotating_shapes import readings_of, rotation_held
from slipguard.stress.shapes import ELONGATED, ShapePose, roughness, soft

OUTLINE_PX = (0.0, 0.1, 0.2, 0.3, 0.5, 0.7, 1.0, 1.5, 2.0, 3.0)
"""Standard deviations of the outline's place, network pixels; the shipped network's is about 0.3."""
GREY = (0.05, 0.1, 0.2, 0.3, 0.4, 0.5)
"""Standard deviations of white noise on the probability."""


def _begin(product: ProductFunctions) -> TrialFunction:
    levels = [("outline", level) for level in OUTLINE_PX] + [("grey", level) for level in GREY]
    names = tuple(ELONGATED)

    def trial(rng: np.random.Generator, seed: int, results: FamilyResults) -> None:
        curve, level = levels[seed % len(levels)]
        shape = ELONGATED[names[seed // len(levels) % len(names)]]
        a = ShapePose(rng.uniform(-180, 180), rng.uniform(50, 69), rng.uniform(65, 94), rng.uniform(0.8, 1.15))
        rotation = float(rng.uniform(-20, 20))
        b = ShapePose(a.angle_deg + rotation, a.x_px + rng.uniform(-4, 4), a.y_px + rng.uniform(-4, 4), a.scale)
        if curve == "outline":
            rough = roughness(rng, level), roughness(rng, level)
            maps = soft(shape, a, rough[0]), soft(shape, b, rough[1])
            error = rotation_held(shape, a, b, product, results, rough)
        else:
            maps = _grey(soft(shape, a), level, rng), _grey(soft(shape, b), level, rng)
            finger = ScriptedPipeline(product)
            error = None
            for shown, truth in zip(maps, (0.0, rotation), strict=True):
                answer = results.call("pipeline", finger.see, shown)
                if answer is None:
                    return
                error = results.check_angle("pipeline", answer.angle_deg, answer.sigma_deg, truth, axial=False)
        results.add_curve_point(f"{curve}/pipeline", level, error)
        readings = readings_of(maps, product, results)
        if readings is not None:
            for name, one in compare(readings[0], readings[1], rotation, results).items():
                results.add_curve_point(f"{curve}/{name}", level, one)

    return trial


def _grey(probability: Map, sigma: float, rng: np.random.Generator) -> Map:
    noise = np.float32(sigma) * rng.standard_normal(probability.shape, dtype=np.float32)
    return np.clip(probability + noise, 0.0, 1.0).astype(np.float32)


NOISE = TrialFamily(
    "noise", "outlines and probabilities with growing noise", 12_000, 11.0, _begin, min_answered_share=0.75
)
