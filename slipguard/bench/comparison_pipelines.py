"""Pipelines to compare slipguard with: the paper's, its axis, background subtraction, and one that answers 0."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from slipguard.devices import FRAME_HEIGHT_PX, FRAME_WIDTH_PX, Frame
from slipguard.errors import ModelError
from slipguard.perception.axis import axial_difference_deg, wrap_axial_deg
from slipguard.perception.estimate import Estimate


class FrameProcessor(Protocol):
    """Processes the frames of one grasp in order."""

    def process(self, frame: Frame) -> Estimate: ...

    @property
    def last_mask(self) -> NDArray[np.uint8]: ...


class AxialRotation:
    """Rotation since the first axis, in (-90, 90]: an axis that jumps does not affect later frames."""

    def __init__(self) -> None:
        self._first_deg: float | None = None

    def estimate(self, frame: Frame, axis_deg: float, method: str, contact: bool | None = None) -> Estimate:
        """Return the estimate for an axis, without sigma; NaN: no axis. contact: None if an axis means contact."""
        rotation_deg = None
        if math.isfinite(axis_deg):
            if self._first_deg is None:
                self._first_deg = axis_deg
            rotation_deg = axial_difference_deg(axis_deg, self._first_deg)
        at_s, declined = frame.captured_at_s, None if rotation_deg is not None else "no axis"
        seen = rotation_deg is not None if contact is None else contact
        return Estimate(frame.sequence, at_s, at_s, seen, 0, method, rotation_deg=rotation_deg, declined=declined)


def axis_of_mask(mask: NDArray[np.uint8]) -> float:
    """Return the direction of the largest variance of a mask's pixels, degrees counter-clockwise; NaN without any."""
    y, x = np.nonzero(mask)
    if x.size < 2:
        return math.nan
    dx, dy = x - x.mean(), y - y.mean()
    return wrap_axial_deg(-math.degrees(math.atan2(2.0 * float(dx @ dy), float(dx @ dx - dy @ dy))) / 2.0)


def _thinned(mask: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.asarray(cv2.ximgproc.thinning(mask * np.uint8(255), thinningType=cv2.ximgproc.THINNING_GUOHALL), np.uint8)


MIN_THRESHOLD_LEVELS = 10.0
"""A lower threshold, in gray levels, would follow the noise."""
BLUR_PX = 2.0
_DISC = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (15, 15))


class BackgroundSubtraction:
    """Rotation since the first frame by PCA of the mask; no sigma."""

    def __init__(self, background: NDArray[np.uint8]) -> None:
        self._background = background.astype(np.float32)
        self._rotation = AxialRotation()
        self.last_mask: NDArray[np.uint8] = np.zeros(background.shape[:2], np.uint8)

    def process(self, frame: Frame) -> Estimate:
        """Segment the largest region that differs from the background image by more than a uniform change of light."""
        change = frame.image.astype(np.float32) - self._background
        change -= np.median(change[::8, ::8], axis=(0, 1))
        strength = cv2.GaussianBlur(np.abs(change).max(axis=2), (0, 0), BLUR_PX)
        levels = np.asarray(np.clip(strength, 0, 255), np.uint8)
        otsu, _ = cv2.threshold(levels, 0, 255, cv2.THRESH_OTSU)
        above = np.asarray(strength > max(otsu, MIN_THRESHOLD_LEVELS), np.uint8)
        closed = np.asarray(cv2.morphologyEx(above, cv2.MORPH_CLOSE, _DISC), np.uint8)
        count, labels, stats, _ = cv2.connectedComponentsWithStats(closed)
        largest = 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA])) if count > 1 else 0
        self.last_mask = np.asarray((labels == largest) & (largest > 0), np.uint8)
        return self._rotation.estimate(frame, axis_of_mask(self.last_mask), "pca")


class SkeletonAxis:
    """The paper's axis, by thinning and a line, on the masks of another pipeline; no sigma."""

    def __init__(self, pipeline: FrameProcessor) -> None:
        self._pipeline = pipeline
        self._rotation = AxialRotation()

    @property
    def last_mask(self) -> NDArray[np.uint8]:
        return self._pipeline.last_mask

    def process(self, frame: Frame) -> Estimate:
        """Process the frame by the other pipeline, then thin its mask at the network's size."""
        contact = self._pipeline.process(frame).contact
        mask = self._pipeline.last_mask if contact else np.zeros_like(self._pipeline.last_mask)
        small = cv2.resize(mask, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_NEAREST)
        return self._rotation.estimate(frame, axis_of_mask(_thinned(np.asarray(small, np.uint8))), "skeleton", contact)


class ZeroRotation:
    """Always answers 0: any pipeline must be better."""

    last_mask: NDArray[np.uint8] = np.zeros((FRAME_HEIGHT_PX, FRAME_WIDTH_PX), np.uint8)

    def process(self, frame: Frame) -> Estimate:
        at_s = frame.captured_at_s
        return Estimate(frame.sequence, at_s, at_s, True, 0, "zero", rotation_deg=0.0)


MEAN_RGB, STD_RGB = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
ESTIMATOR_MAP_PX = (120, 160)
"""Width and height of the maps that slipguard's estimators use; larger outputs are reduced to it."""


class FrameNetwork:
    """A segmentation network of any size whose only input is the frame, such as the paper's.

    Input: (1, H, W, 3) uint8 BGR, or (1, 3, H, W) float32 RGB normalized as for ImageNet. Output: (1, 1, H, W)
    probability. Raises `ModelError` for any other file.
    """

    def __init__(self, path: Path, threads: int = 1) -> None:
        options = ort.SessionOptions()
        options.intra_op_num_threads, options.inter_op_num_threads = threads, 1
        options.log_severity_level = 3
        try:
            self._session: Any = ort.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
        except Exception as error:
            raise ModelError(f"{path}: not a readable ONNX model. Export it again") from error
        ports = self._session.get_inputs()
        shape = ports[0].shape
        self._bytes = ports[0].type == "tensor(uint8)"
        sides = shape[1:3] if self._bytes else shape[2:4]
        if len(ports) != 1 or len(shape) != 4 or not all(isinstance(side, int) for side in sides):
            inputs = ", ".join(f"{port.name} {port.type}{port.shape}" for port in ports)
            raise ModelError(f"{path}: the inputs are {inputs}. One image of a fixed size is needed")
        self.path = path
        self.metadata = dict(self._session.get_modelmeta().custom_metadata_map)
        self._name = ports[0].name
        self.height, self.width = int(sides[0]), int(sides[1])
        self.threshold = float(self.metadata.get("threshold", "0.5"))
        self.timing_only = "timing only" in self.metadata.get("purpose", "")

    @property
    def input_size(self) -> tuple[int, int]:
        """(width, height) of the output of `segment`."""
        return ESTIMATOR_MAP_PX

    def segment(self, image: NDArray[np.uint8], _background: NDArray[np.uint8] | None) -> NDArray[np.float32]:
        """Return the probability of contact, (160, 120) float32, for slipguard's estimators."""
        fine = self.probability(image)
        return np.asarray(cv2.resize(fine, ESTIMATOR_MAP_PX, interpolation=cv2.INTER_AREA), np.float32)

    def probability(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return the probability of contact at the network's size, (H, W) float32."""
        small: Any = image
        if image.shape[:2] != (self.height, self.width):
            small = cv2.resize(image, (self.width, self.height), interpolation=cv2.INTER_AREA)
        if not self._bytes:
            mean, std = np.asarray(MEAN_RGB, np.float32), np.asarray(STD_RGB, np.float32)
            rgb = (small[..., ::-1].astype(np.float32) / np.float32(255.0) - mean) / std
            small = rgb.transpose(2, 0, 1)
        output = self._session.run(None, {self._name: np.ascontiguousarray(small[None])})[0]
        if not np.isfinite(output).all():
            raise ModelError(f"{self.path}: the network's output is not finite. Export the network again")
        return np.asarray(np.clip(output.reshape(self.height, self.width), 0.0, 1.0), np.float32)


class PaperPipeline:
    """The paper's pipeline: segmentation, OpenCV's thinning and a line through the skeleton; no sigma, no skipping.

    given_masks: masks by frame number, used instead of the output of a network with arbitrary weights.
    """

    def __init__(self, network: FrameNetwork, given_masks: dict[int, NDArray[np.uint8]] | None = None) -> None:
        self._network = network
        self._given = given_masks
        self._rotation = AxialRotation()
        self._mask: NDArray[np.uint8] = np.zeros((network.height, network.width), np.uint8)

    @property
    def last_mask(self) -> NDArray[np.uint8]:
        """The last mask at the frame's size, (320, 240) uint8; enlarged here, outside the measured time."""
        return _at_size(self._mask, FRAME_WIDTH_PX, FRAME_HEIGHT_PX)

    def process(self, frame: Frame) -> Estimate:
        """Segment, thin at the network's size, fit a line, and return its rotation since the first frame."""
        probability = self._network.probability(frame.image)
        mask = (probability > self._network.threshold).astype(np.uint8)
        if self._given is not None:
            mask = _at_size(self._given[frame.sequence], self._network.width, self._network.height)
        self._mask = mask
        return self._rotation.estimate(frame, axis_of_mask(_thinned(mask)), "skeleton", bool(mask.any()))


def _at_size(mask: NDArray[np.uint8], width: int, height: int) -> NDArray[np.uint8]:
    if mask.shape == (height, width):
        return mask
    return np.asarray(cv2.resize(mask, (width, height), interpolation=cv2.INTER_NEAREST), np.uint8)
