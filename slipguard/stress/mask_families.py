"""Trial families on masks: every degenerate mask through the whole pipeline, and a million random ones."""

from __future__ import annotations

import cv2
import numpy as np

from slipguard.perception.contact.patch import MEAN_MIN
from slipguard.stress.map_checks import (
    Map,
    check_registration_with_itself,
    check_sequence,
    check_symmetry,
    check_thinning,
    find_checked_patch,
    rotate_and_mirror,
)
from slipguard.stress.masks import Mask, degenerate_masks, random_mask
from slipguard.stress.product_functions import MAP_WIDTH_PX, THRESHOLD, ProductFunctions, ScriptedPipeline
from slipguard.stress.trial_family import FamilyResults, TrialFamily, TrialFunction

STYLES = 3
"""How a mask becomes a map: 0 and 1; at the threshold, and just above the smallest mean of a contact; blurred."""
STEADY_FRAMES = 6


def as_map(mask: Mask, style: int) -> Map:
    """Return a probability map with this mask (approximately, if blurred)."""
    if style == 0:
        return mask.astype(np.float32)
    if style == 1:
        above = np.nextafter(np.float32(MEAN_MIN), np.float32(1.0))
        return np.where(mask > 0, above, np.float32(THRESHOLD)).astype(np.float32)
    return np.asarray(cv2.GaussianBlur(mask.astype(np.float32), (0, 0), 1.0), np.float32)


def _begin_degenerate(product: ProductFunctions) -> TrialFunction:
    masks = list(degenerate_masks().values())

    def trial(rng: np.random.Generator, seed: int, results: FamilyResults) -> None:
        seed, number = divmod(seed, len(masks))
        style, which = divmod(seed, 8)
        mask = np.asarray(rotate_and_mirror(masks[number], which), np.uint8)
        check_thinning(mask, product, results)
        probability = as_map(mask, style % STYLES)
        for min_area_px in (1.0, 200.0):
            check_symmetry(probability, int(rng.integers(1, 8)), min_area_px, product, results)
        patch = find_checked_patch(probability, 1.0, product, results)
        if patch is not None:
            check_registration_with_itself(patch, product, results)
        if max(mask.shape) == 160:
            _check_at_rest(probability if mask.shape[1] == MAP_WIDTH_PX else probability.T, product, results)

    return trial


def _check_at_rest(probability: Map, product: ProductFunctions, results: FamilyResults) -> None:
    """Show the map at rest, then a full and an empty map, then the map again: the rotation stays zero."""
    probability = np.ascontiguousarray(probability)
    interruption = [np.ones_like(probability), np.zeros_like(probability), probability]
    shown = [probability] * STEADY_FRAMES + interruption
    check_sequence(ScriptedPipeline(product, "stable"), ((one, 0.0) for one in shown), results)


def _begin_random(product: ProductFunctions) -> TrialFunction:
    def trial(rng: np.random.Generator, seed: int, results: FamilyResults) -> None:
        mask = random_mask(rng)
        check_thinning(mask, product, results)
        probability = as_map(mask, int(rng.choice((0, 2))))
        check_symmetry(probability, int(rng.integers(1, 8)), float(rng.choice((1, 100))), product, results)

    return trial


DEGENERATE = TrialFamily(
    "degenerate", "degenerate masks in eight orientations", len(degenerate_masks()) * 8 * STYLES, 30.0,
    _begin_degenerate, min_answered_share=0.2,
)  # fmt: skip
RANDOM = TrialFamily(
    "random", "random masks: thinning as in OpenCV, symmetric axes", 1_000_000, 1.8, _begin_random,
    min_answered_share=0.8,
)  # fmt: skip
