"""Shapes read twice, and shapes turned frame by frame through the whole pipeline."""

from __future__ import annotations

import math

from slipguard.perception.estimate import AxisEstimate
from slipguard.stress.family import FamilyResults
from slipguard.stress.map_checks import Map, patch_of, read
from slipguard.stress.product_functions import MAP_PX, ProductFunctions, ScriptedPipeline
from slipguard.stress.shapes import Distance, ShapePose, soft

STEP_DEG = 5.0
"""A fall turns an object by this much from frame to frame."""


def readings_of(
    maps: tuple[Map, Map], product: ProductFunctions, results: FamilyResults
) -> list[dict[str, AxisEstimate]] | None:
    patches = [patch_of(one, 100.0, MAP_PX, product, results) for one in maps]
    return [read(one, product, results) for one in patches if one is not None] if None not in patches else None


def rotation_held(
    shape: Distance,
    start: ShapePose,
    end: ShapePose,
    product: ProductFunctions,
    results: FamilyResults,
    noise: tuple[Map | None, Map | None],
) -> float | None:
    """Turn a shape frame by frame through the pipeline; the last answer's error, None where it declined.

    noise: roughness of the reference and of the last frame; those between carry the last one's.
    """
    finger = ScriptedPipeline(product)
    rotation = end.angle_deg - start.angle_deg
    steps = max(1, math.ceil(abs(rotation) / STEP_DEG))
    error = None
    for k in range(steps + 1):
        part = k / steps
        pose = ShapePose(
            start.angle_deg + part * rotation,
            start.x_px + part * (end.x_px - start.x_px),
            start.y_px + part * (end.y_px - start.y_px),
            start.scale + part * (end.scale - start.scale),
            start.mirrored,
        )
        answer = results.call("pipeline", finger.see, soft(shape, pose, noise[0] if k == 0 else noise[1]))
        if answer is None:
            return None
        results.check_finite("pipeline", answer.orientation_deg, answer.rate_deg_s, *(answer.shift_mm or ()))
        error = results.check_angle("pipeline", answer.angle_deg, answer.sigma_deg, part * rotation, axial=False)
    return error
