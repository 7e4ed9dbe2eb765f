"""Trial families on masks: every degenerate mask through the whole chain, and a million random ones."""

from __future__ import annotations

import cv2
import numpy as np

from slipguard.stress.map_checks import Map, check_laid_over_itself, check_rotated, check_thinning, patch_of
from slipguard.stress.masks import Mask, degenerate, rotated, scattered
from slipguard.stress.product_functions import MAP_PX, MAP_WIDTH_PX, THRESHOLD, ProductFunctions, ScriptedPipeline
from slipguard.stress.trial_family import FamilyResults, TrialFamily, TrialFunction

STYLES = 3
"""How a mask becomes a map: 0 and 1; just below and just above the threshold; blurred."""
STEADY_FRAMES = 6


def as_map(mask: Mask, style: int) -> Map:
    """A probability map whose mask this is (blurred: nearly)."""
    if style == 0:
        return mask.astype(np.float32)
    if style == 1:
        above = np.nextafter(np.float32(THRESHOLD), np.float32(1.0))
        return np.where(mask > 0, above, np.float32(THRESHOLD)).astype(np.float32)
    return np.asarray(cv2.GaussianBlur(mask.astype(np.float32), (0, 0), 1.0), np.float32)


def _begin_degenerate(product: ProductFunctions) -> TrialFunction:
    masks = list(degenerate().values())

    def trial(rng: np.random.Generator, seed: int, results: FamilyResults) -> None:
        seed, number = divmod(seed, len(masks))
        style, which = divmod(seed, 8)
        mask = np.asarray(rotated(masks[number], which), np.uint8)
        check_thinning(mask, product, results)
        probability = as_map(mask, style % STYLES)
        for min_area_px in (1.0, 200.0):
            check_rotated(probability, int(rng.integers(1, 8)), min_area_px, MAP_PX, product, results)
        patch = patch_of(probability, 1.0, MAP_PX, product, results)
        if patch is not None:
            check_laid_over_itself(patch, product, results)
        if max(mask.shape) == 160:
            _hold(probability if mask.shape[1] == MAP_WIDTH_PX else probability.T, product, results)

    return trial


def _hold(probability: Map, product: ProductFunctions, results: FamilyResults) -> None:
    """Held still, blinded by a full and an empty map, and seen again: it has not turned at any time."""
    probability = np.ascontiguousarray(probability)
    finger = ScriptedPipeline(product, "stable")
    blinded = [np.ones_like(probability), np.zeros_like(probability), probability]
    for shown in [probability] * STEADY_FRAMES + blinded:
        answer = results.call("pipeline", finger.see, shown)
        if answer is None:
            return
        results.check_finite("pipeline", answer.orientation_deg, answer.rate_deg_s, *(answer.shift_mm or ()))
        results.check_angle("pipeline", answer.angle_deg, answer.sigma_deg, 0.0, axial=False)


def _begin_random(product: ProductFunctions) -> TrialFunction:
    def trial(rng: np.random.Generator, seed: int, results: FamilyResults) -> None:
        mask = scattered(rng)
        check_thinning(mask, product, results)
        probability = as_map(mask, int(rng.choice((0, 2))))
        check_rotated(probability, int(rng.integers(1, 8)), float(rng.choice((1, 100))), MAP_PX, product, results)

    return trial


DEGENERATE_MASKS = len(degenerate())
DEGENERATE = TrialFamily(
    "degenerate",
    "every mask that is hardly one, turned eight ways",
    DEGENERATE_MASKS * 8 * STYLES,
    30.0,
    _begin_degenerate,
    min_answered_share=0.2,
)
RANDOM = TrialFamily(
    "random",
    "random masks: thinned as OpenCV does, read alike in mirrors",
    1_000_000,
    1.8,
    _begin_random,
    min_answered_share=0.8,
)
