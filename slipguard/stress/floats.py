"""Numbers at their limits: float32 against float64, denormal, huge and non-finite probabilities."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.stress.family import FamilyResults, TrialFamily, TrialFunction
from slipguard.stress.map_checks import Map, check_laid_over_itself, compare, patch_of, read
from slipguard.stress.product_functions import MAP_PX, ProductFunctions, ScriptedPipeline
from slipguard.stress.shapes import ELONGATED, ShapePose, soft

PRECISION_DEG = 0.01
"""What single precision may change in an axis."""
POISONS = (math.nan, math.inf, -math.inf, 3e38, -3e38, 1e-40, -1e-40, -0.0)
SHARES = (0.0005, 0.01, 0.1, 0.5, 1.0)


def _begin(product: ProductFunctions) -> TrialFunction:
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
    _begin,
    min_answered_share=0.65,
)
