"""The paper's pipeline, as published: one of its networks, OpenCV's thinning, a line through all of the skeleton."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from slipguard.bench.axes import AxialRotation, axis_of_points
from slipguard.bench.cached_segmenter import SegmentationCache
from slipguard.devices import FRAME_HEIGHT_PX, FRAME_WIDTH_PX, Frame
from slipguard.errors import ModelError
from slipguard.perception.estimate import Estimate

MIN_AREA_PX = 200
MEAN_RGB, STD_RGB = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
OURS_PX = (120, 160)
"""What slipguard's estimators are made for; finer answers are reduced to it."""


class FrameNetwork:
    """A segmentation network that sees the frame alone, any size: how the paper's networks come.

    Its one input is `frame` (1, H, W, 3) uint8 BGR, or (1, 3, H, W) float32 RGB normalised as for ImageNet; its output
    (1, 1, H, W) probability. Raises `ModelError` in one line for another file.
    """

    def __init__(self, path: Path, threads: int = 1) -> None:
        options = ort.SessionOptions()
        options.intra_op_num_threads, options.inter_op_num_threads = threads, 1
        options.log_severity_level = 3
        try:
            self._session: Any = ort.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
        except Exception as error:
            raise ModelError(f"{path}: not a readable ONNX model; export it with slipguard train --arch") from error
        ports = self._session.get_inputs()
        shape = ports[0].shape
        self._bytes = ports[0].type == "tensor(uint8)"
        sides = shape[1:3] if self._bytes else shape[2:4]
        if len(ports) != 1 or len(shape) != 4 or not all(isinstance(side, int) for side in sides):
            seen = ", ".join(f"{port.name} {port.type}{port.shape}" for port in ports)
            raise ModelError(f"{path}: inputs are {seen}; one picture of a fixed size is needed")
        self.path = path
        self.metadata = dict(self._session.get_modelmeta().custom_metadata_map)
        self._name = ports[0].name
        self.height, self.width = int(sides[0]), int(sides[1])
        self.threshold = float(self.metadata.get("threshold", "0.5"))
        self.memory = SegmentationCache()
        self.made_up = "timing only" in self.metadata.get("purpose", "")

    @property
    def input_size(self) -> tuple[int, int]:
        """(width, height) of `segment`'s answer."""
        return OURS_PX

    def segment(self, image: NDArray[np.uint8], _background: NDArray[np.uint8] | None) -> NDArray[np.float32]:
        """Probability of contact, (160, 120) float32, for slipguard's own estimators."""
        fine = self.probability(image)
        return np.asarray(cv2.resize(fine, OURS_PX, interpolation=cv2.INTER_AREA), np.float32)

    def probability(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Probability of contact at the network's own size, (H, W) float32.

        While its memory is on it gives the same answer for the same picture and charges its time to `CLOCK`.
        """
        return self.memory.recall(image, self._answer)

    def _answer(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        small: Any = image
        if image.shape[:2] != (self.height, self.width):
            small = cv2.resize(image, (self.width, self.height), interpolation=cv2.INTER_AREA)
        if not self._bytes:
            mean, std = np.asarray(MEAN_RGB, np.float32), np.asarray(STD_RGB, np.float32)
            rgb = (small[..., ::-1].astype(np.float32) / np.float32(255.0) - mean) / std
            small = rgb.transpose(2, 0, 1)
        answer = self._session.run(None, {self._name: np.ascontiguousarray(small[None])})[0]
        if not np.isfinite(answer).all():
            raise ModelError(f"{self.path}: the network's answer is not finite; make the file again")
        return np.asarray(np.clip(answer.reshape(self.height, self.width), 0.0, 1.0), np.float32)


class PaperPipeline:
    """Frame in, turn since the first frame out, without a sigma; every frame goes all the way.

    given_masks: masks by frame number that take the place of the answer of a network with made-up weights.
    """

    def __init__(self, network: FrameNetwork, given_masks: dict[int, NDArray[np.uint8]] | None = None) -> None:
        self._network = network
        self._given = given_masks
        self._rotation = AxialRotation()
        self._mask: NDArray[np.uint8] = np.zeros((network.height, network.width), np.uint8)

    @property
    def last_mask(self) -> NDArray[np.uint8]:
        """At the frame's size, (320, 240) uint8; enlarged when asked for, which no frame's time is charged with."""
        return _at_size(self._mask, FRAME_WIDTH_PX, FRAME_HEIGHT_PX)

    def process(self, frame: Frame) -> Estimate:
        """Segment, thin at the network's own size, fit a line, compare with the first one."""
        probability = self._network.probability(frame.image)
        mask = (probability > self._network.threshold).astype(np.uint8)
        if self._given is not None:
            mask = _at_size(self._given[frame.sequence], self._network.width, self._network.height)
        self._mask = mask
        skeleton = cv2.ximgproc.thinning(mask * np.uint8(255), thinningType=cv2.ximgproc.THINNING_GUOHALL)
        y, x = np.nonzero(skeleton)
        angle_deg = axis_of_points(x, y) if x.size > 1 else math.nan
        area_px = int(np.count_nonzero(mask)) * FRAME_WIDTH_PX * FRAME_HEIGHT_PX // mask.size
        return self._rotation.estimate(frame, angle_deg, area_px, "skeleton")


def _at_size(mask: NDArray[np.uint8], width: int, height: int) -> NDArray[np.uint8]:
    if mask.shape == (height, width):
        return mask
    return np.asarray(cv2.resize(mask, (width, height), interpolation=cv2.INTER_NEAREST), np.uint8)
