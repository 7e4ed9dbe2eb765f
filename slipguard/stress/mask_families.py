"""Trial family on masks: every degenerate mask through the whole pipeline, with and without a background image."""

from __future__ import annotations

from itertools import cycle

import cv2
import numpy as np

from slipguard.perception.patch import MEAN_MIN
from slipguard.stress.map_checks import Map, check_sequence, check_thinning, estimate_axes, find_checked_patch
from slipguard.stress.masks import Mask, degenerate_masks
from slipguard.stress.product_functions import (
    MAP_HEIGHT_PX,
    MAP_WIDTH_PX,
    THRESHOLD,
    ProductFunctions,
    ScriptedPipeline,
)
from slipguard.stress.textured_surfaces import LEVEL, LedLights, heights, lettered, shaded_image
from slipguard.stress.trial_family import FamilyResults, TrialFamily, TrialFunction

STYLES = 3
"""How a mask becomes a map: 0 and 1; at the threshold, and just above the smallest mean of a contact; blurred."""
FLIPS: tuple[tuple[int, ...], ...] = ((), (0,), (1,), (0, 1))
STEADY_FRAMES = 4


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
    background = np.full((320, 240, 3), round(LEVEL), np.uint8)
    pressed, noise = heights(lettered, 20.0, (119.5, 159.5), 1.0), np.random.default_rng(0)
    images = cycle([shaded_image(pressed, LedLights(), 1.0, noise) for _ in range(STEADY_FRAMES)])

    def trial(rng: np.random.Generator, seed: int, results: FamilyResults) -> None:
        seed, number = divmod(seed, len(masks))
        style, which = divmod(seed, len(FLIPS))
        mask = np.ascontiguousarray(np.flip(masks[number], FLIPS[which]))
        check_thinning(mask, product, results)
        probability = as_map(mask, style % STYLES)
        for min_area_px in (1.0, 200.0):
            patch = find_checked_patch(probability, min_area_px, product, results)
            if patch is not None:
                estimate_axes(patch, product, results)
        if mask.shape != (MAP_HEIGHT_PX, MAP_WIDTH_PX):
            return
        # At rest, then a full and an empty map, then the map again: the rotation stays zero.
        shown = [probability] * STEADY_FRAMES + [np.ones_like(probability), np.zeros_like(probability), probability]
        at_rest = [(one, 0.0) for one in shown]
        check_sequence(ScriptedPipeline(product), at_rest, results, "pipeline, mask")
        textured = ScriptedPipeline(product, background=background, every_map=True)
        check_sequence(textured, at_rest, results, "pipeline, texture", images)

    return trial


DEGENERATE = TrialFamily(
    "degenerate", "degenerate masks, flipped, through the whole pipeline",
    len(degenerate_masks()) * len(FLIPS) * STYLES, 40.0, _begin_degenerate, min_answered_share=0.15,
)  # fmt: skip
