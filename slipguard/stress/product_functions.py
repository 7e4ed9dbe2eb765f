"""What is put under stress: the functions of the product, each replaceable, and a network that answers as told."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slipguard.control.finger_fusion import FusedEstimate, fuse
from slipguard.devices import FRAME_HEIGHT_PX, FRAME_WIDTH_PX, Frame
from slipguard.perception.contact.patch import Patch, find_patch
from slipguard.perception.contact.segmenter import Segmenter
from slipguard.perception.estimate import AxisEstimate, Estimate
from slipguard.perception.pipeline import ContactSegmenter, Pipeline
from slipguard.perception.rotation.axis import estimate
from slipguard.perception.rotation.contour_registration import ContourRegistrar
from slipguard.perception.rotation.thinning import thin
from slipguard.perception.rotation.tracker import RotationTracker
from slipguard.perception.settings import PerceptionSettings

MAP_WIDTH_PX, MAP_HEIGHT_PX = 120, 160
MAP_PX = FRAME_WIDTH_PX / MAP_WIDTH_PX
"""Frame pixels per pixel of the network's map."""
THRESHOLD = 0.5
PX_PER_MM = 18.5
FRAME_S = 1.0 / 60.0


@dataclass(frozen=True, slots=True)
class ProductFunctions:
    """The product's own functions; a test hands in broken ones to see that they are caught."""

    find_patch: Callable[[NDArray[np.float32], float, float, float], Patch | None] = find_patch
    estimate: Callable[[Patch, str], AxisEstimate] = estimate
    thin: Callable[[NDArray[np.uint8]], NDArray[np.uint8]] = thin
    registrar: Callable[..., ContourRegistrar] = ContourRegistrar
    tracker: Callable[[], RotationTracker] = RotationTracker
    fuse: Callable[[Estimate | None, Estimate | None], FusedEstimate | None] = fuse
    pipeline: Callable[..., Any] = Pipeline
    segmenter: Callable[[], ContactSegmenter] = Segmenter


class ScriptedSegmenter:
    """A segmenter that answers with the map it was given last: (160, 120) float32."""

    threshold = THRESHOLD
    input_size = (MAP_WIDTH_PX, MAP_HEIGHT_PX)

    def __init__(self) -> None:
        self.map: NDArray[np.float32] = np.zeros((MAP_HEIGHT_PX, MAP_WIDTH_PX), np.float32)

    def segment(self, image: NDArray[np.uint8], background: NDArray[np.uint8] | None) -> NDArray[np.float32]:
        return self.map


class ScriptedPipeline:
    """The whole pipeline behind a scripted network: maps in, estimates out."""

    def __init__(self, product: ProductFunctions, reference: str = "first", estimator: str = "fused") -> None:
        self._segmenter = ScriptedSegmenter()
        choices = {"reference": reference, "estimator": estimator, "skip_unchanged": False}
        settings = PerceptionSettings.model_validate(choices)
        self._pipeline = product.pipeline(self._segmenter, settings, None, None, PX_PER_MM)
        self._image: NDArray[np.uint8] = np.full((FRAME_HEIGHT_PX, FRAME_WIDTH_PX, 3), 96, np.uint8)
        self._frames = 0

    def see(self, probability: NDArray[np.float32], at_s: float | None = None) -> Estimate:
        """The estimate of the next frame; without a time 1/60 s after the last one. Errors are the pipeline's."""
        self._frames += 1
        self._segmenter.map = probability
        when_s = self._frames * FRAME_S if at_s is None else at_s
        answer: Estimate = self._pipeline.process(Frame(self._image, when_s, self._frames))
        return answer


class ScriptedImagePipeline:
    """The same with a no-contact image, and pictures in which the relief of the contact can be seen."""

    def __init__(self, product: ProductFunctions, background: NDArray[np.uint8]) -> None:
        self._segmenter = ScriptedSegmenter()
        settings = PerceptionSettings(reference="first", skip_unchanged=False)
        self._pipeline = product.pipeline(self._segmenter, settings, background, None, PX_PER_MM)
        self._frames = 0
        self._now_s = 0.0

    def see(self, image: NDArray[np.uint8], probability: NDArray[np.float32], after_s: float = FRAME_S) -> Estimate:
        """The estimate of a frame so long after the last one. Errors are the pipeline's."""
        self._frames += 1
        self._now_s += after_s
        self._segmenter.map = probability
        answer: Estimate = self._pipeline.process(Frame(image, self._now_s, self._frames))
        return answer
