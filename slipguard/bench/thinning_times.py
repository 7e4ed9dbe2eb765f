"""Times of slipguard's thinning, OpenCV's and scikit-image's."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from skimage.morphology import skeletonize
from skimage.morphology import thin as skimage_thin

from slipguard.bench.results import ThinningResult
from slipguard.perception.skeleton import thin

MARGIN_PX = 2


def compare_thinning(masks: list[NDArray[np.uint8]], repeats: int = 3) -> tuple[ThinningResult, ...]:
    """Measure each implementation: the minimum of some repeats, the median over masks of (320, 240) uint8, 0 or 1.

    Sizes: the frame, the network's 120×160, and the contact's bounding box in the latter.
    """
    halves = [np.asarray(cv2.resize(mask, (120, 160), interpolation=cv2.INTER_NEAREST), np.uint8) for mask in masks]
    crops = [_crop(mask) for mask in halves if mask.any()]
    return tuple(
        _one(size, some, repeats)
        for size, some in (("240×320", masks), ("120×160", halves), ("crop of 120×160", crops))
    )


def _one(size: str, masks: list[NDArray[np.uint8]], repeats: int) -> ThinningResult:
    implementations: dict[str, Callable[[NDArray[np.uint8]], Any]] = {
        "cv2": lambda mask: cv2.ximgproc.thinning(mask * np.uint8(255), thinningType=cv2.ximgproc.THINNING_GUOHALL),
        "scikit-image thin": skimage_thin,
        "scikit-image skeletonize": skeletonize,
    }
    own_ms = _median_ms(thin, masks, repeats)
    others_ms = {
        name: _median_ms(implementation, masks, repeats if name == "cv2" else 1)
        for name, implementation in implementations.items()
    }
    different = sum(int(np.count_nonzero((implementations["cv2"](mask) > 0) != (thin(mask) > 0))) for mask in masks)
    ratios = {name: ms / own_ms for name, ms in others_ms.items()}
    return ThinningResult(size, len(masks), own_ms, others_ms, ratios, different)


def _median_ms(
    implementation: Callable[[NDArray[np.uint8]], Any], masks: list[NDArray[np.uint8]], repeats: int
) -> float:
    return float(np.median([min(_spent_ms(implementation, mask) for _ in range(repeats)) for mask in masks]))


def _spent_ms(implementation: Callable[[NDArray[np.uint8]], Any], mask: NDArray[np.uint8]) -> float:
    start_s = time.perf_counter()
    implementation(mask)
    return 1e3 * (time.perf_counter() - start_s)


def _crop(mask: NDArray[np.uint8]) -> NDArray[np.uint8]:
    x, y, w, h = cv2.boundingRect(mask)
    crop = mask[y : y + h, x : x + w]
    return np.ascontiguousarray(np.pad(crop, MARGIN_PX))
