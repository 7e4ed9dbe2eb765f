"""The product's functions under test, each replaceable, and the whole pipeline behind a scripted network."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slipguard.control.finger_fusion import FusedEstimate, fuse
from slipguard.devices import FRAME_HEIGHT_PX, FRAME_WIDTH_PX, Frame
from slipguard.perception.axis import estimate_axis
from slipguard.perception.estimate import AxisEstimate, Estimate
from slipguard.perception.patch import Patch, find_patch
from slipguard.perception.pipeline import ContactSegmenter, Pipeline
from slipguard.perception.rotation_filter import RotationFilter
from slipguard.perception.segmenter import Segmenter
from slipguard.perception.settings import PerceptionSettings
from slipguard.perception.skeleton import thin
from slipguard.perception.skipping import Skips

MAP_WIDTH_PX, MAP_HEIGHT_PX = 120, 160
MAP_PX = FRAME_WIDTH_PX / MAP_WIDTH_PX
"""Frame pixels per pixel of the network's map."""
THRESHOLD = 0.5
PX_PER_MM = 18.5
FRAME_S = 1.0 / 60.0


@dataclass(frozen=True, slots=True)
class ProductFunctions:
    """The product's functions. Tests replace some of them with faulty ones to show that the trials detect it."""

    find_patch: Callable[[NDArray[np.float32], float, float, float], Patch | None] = find_patch
    estimate: Callable[[Patch, str], AxisEstimate] = estimate_axis
    thin: Callable[[NDArray[np.uint8]], NDArray[np.uint8]] = thin
    rotations: Callable[[], RotationFilter] = RotationFilter
    fuse: Callable[[Estimate | None, Estimate | None], FusedEstimate | None] = fuse
    pipeline: Callable[..., Any] = Pipeline
    segmenter: Callable[[], ContactSegmenter] = Segmenter


class ScriptedSegmenter:
    """A segmenter that returns the probability map in `map`: (160, 120) float32."""

    threshold = THRESHOLD
    input_size = (MAP_WIDTH_PX, MAP_HEIGHT_PX)

    def __init__(self) -> None:
        self.map: NDArray[np.float32] = np.zeros((MAP_HEIGHT_PX, MAP_WIDTH_PX), np.float32)

    def segment(self, image: NDArray[np.uint8], background: NDArray[np.uint8] | None) -> NDArray[np.float32]:
        return self.map


class ScriptedPipeline:
    """The whole pipeline behind a scripted network: probability maps, and images where texture matters, to estimates.

    Args:
        background: (320, 240, 3) uint8 image without contact; None: without texture, as `measure` without a background
            image, so that the rotation is that of the map's axis.
        every_map: The map of every frame is used, also while the texture shows that the contact moves as a whole.
    """

    def __init__(
        self,
        product: ProductFunctions,
        background: NDArray[np.uint8] | None = None,
        *,
        every_map: bool = False,
    ) -> None:
        self._segmenter = ScriptedSegmenter()
        settings = PerceptionSettings.model_validate(
            {
                "estimator": "moments" if background is None else PerceptionSettings().estimator,
                "reference": "first",
                "skip_unchanged": False,
            }
        )
        self._pipeline = product.pipeline(
            self._segmenter, settings, background, None, PX_PER_MM, skips=Skips(whole=not every_map)
        )
        self._image: NDArray[np.uint8] = np.full((FRAME_HEIGHT_PX, FRAME_WIDTH_PX, 3), 96, np.uint8)
        self._frames = 0
        self._now_s = 0.0

    def process(
        self, probability: NDArray[np.float32], image: NDArray[np.uint8] | None = None, after_s: float = FRAME_S
    ) -> Estimate:
        """Return the estimate of a frame captured `after_s` after the last one; errors are the pipeline's."""
        return self.process_at(self._now_s + after_s, probability, image)

    def process_at(
        self, now_s: float, probability: NDArray[np.float32], image: NDArray[np.uint8] | None = None
    ) -> Estimate:
        """Return the estimate of a frame captured at `now_s`; errors are the pipeline's."""
        self._frames += 1
        self._now_s = now_s
        self._segmenter.map = probability
        frame = Frame(self._image if image is None else image, now_s, self._frames)
        estimated: Estimate = self._pipeline.process(frame)
        return estimated
