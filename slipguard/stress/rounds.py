"""Near-circles, polygons, rings and discs at the edge: an honest answer or none."""

from __future__ import annotations

import numpy as np

from slipguard.stress import shapes
from slipguard.stress.family import FamilyResults, TrialFamily, TrialFunction
from slipguard.stress.map_checks import compare
from slipguard.stress.product_functions import ProductFunctions, ScriptedPipeline
from slipguard.stress.rotating_shapes import readings_of, rotation_held
from slipguard.stress.shapes import ShapePose, roughness, soft

ASPECTS = (1.0, 1.01, 1.02, 1.05, 1.1, 1.15, 1.2, 1.25, 1.3, 1.5)
ROUGHS_PX = (0.0, 0.2, 0.4)
ASPECT = "error at aspect 1.2"
ASPECT_ERROR_DEG = 2.0
"""Promised at aspect 1.2 for clean outlines."""


def _begin(product: ProductFunctions) -> TrialFunction:
    def trial(rng: np.random.Generator, seed: int, results: FamilyResults) -> None:
        seed, choice = divmod(seed, len(ASPECTS) + 4)
        rough_px = ROUGHS_PX[seed % len(ROUGHS_PX)]
        shape, label, truth = _near_round(choice, rng)
        rotation = float(rng.uniform(-20, 20))
        out = 1.0 if choice < len(ASPECTS) or rng.random() < 0.5 else float(rng.uniform(1.0, 4.0))
        x, y = 59.5 + out * rng.uniform(-14, 14), 79.5 + out * rng.uniform(-14, 14)
        a = ShapePose(float(rng.uniform(-180, 180)), x, y, float(rng.uniform(0.7, 1.2)))
        b = ShapePose(a.angle_deg + rotation, x + rng.uniform(-2, 2), y + rng.uniform(-2, 2), a.scale)
        rough = roughness(rng, rough_px), roughness(rng, rough_px)
        readings = readings_of((soft(shape, a, rough[0]), soft(shape, b, rough[1])), product, results)
        errors: dict[str, float | None] = {}
        if readings is not None:
            errors = compare(readings[0], readings[1], rotation if truth == "axis" else None, results)
        if truth == "nothing":
            _hold_round(shape, a, rough_px, rng, product, results)
        else:
            errors["pipeline"] = rotation_held(shape, a, b, product, results, rough)
        if choice < len(ASPECTS):
            for reader, error in errors.items():
                results.add_curve_point(f"aspect, outline {rough_px:g} px/{reader}", ASPECTS[choice], error)
                if label == "aspect 1.2" and rough_px == 0.0 and error is not None:
                    results.check_limit(ASPECT, error, ASPECT_ERROR_DEG)

    return trial


def _near_round(choice: int, rng: np.random.Generator) -> tuple[shapes.Distance, str, str]:
    """A shape, its label, and what its turn shows: its axis, its outline, or nothing."""
    if choice < len(ASPECTS):
        aspect = ASPECTS[choice]
        return shapes.round_of(aspect), f"aspect {aspect:g}", "nothing" if aspect == 1.0 else "axis"
    corners = int(rng.integers(3, 13))
    wide = float(rng.uniform(2, 9))
    return (
        (shapes.polygon(corners), f"{corners} corners", "outline"),
        (shapes.DISC, "disc at the edge", "nothing"),
        (shapes.ring(26.0, wide), "ring", "nothing"),
        (shapes.box(22, 22), "square", "outline"),
    )[choice - len(ASPECTS)]


def _hold_round(
    shape: shapes.Distance,
    pose: ShapePose,
    rough_px: float,
    rng: np.random.Generator,
    product: ProductFunctions,
    results: FamilyResults,
) -> None:
    """What shows no turn may claim none, however its outline flickers."""
    finger = ScriptedPipeline(product)
    for _ in range(4):
        answer = results.call("pipeline", finger.see, soft(shape, pose, roughness(rng, rough_px)))
        if answer is None:
            return
        results.check_angle("pipeline", answer.angle_deg, answer.sigma_deg, None, axial=False)


ROUNDS = TrialFamily(
    "round", "near-circles, polygons, rings, discs at the edge", 8_400, 10.0, _begin, min_answered_share=0.18
)
