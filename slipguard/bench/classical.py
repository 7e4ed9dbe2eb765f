"""Pipelines without a network: the difference to the no-contact image, a threshold, an axis."""

from __future__ import annotations

import math
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.bench.axes import AxialRotation, axis_of_ellipse, axis_of_points
from slipguard.devices import Frame
from slipguard.perception.estimate import Estimate

LEAST_LEVELS = 10.0
"""A threshold below this many grey levels would follow the noise."""
BLUR_PX = 2.0
_DISC = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (15, 15))


class BackgroundSubtraction:
    """Turn since the first frame by PCA of the mask or an ellipse round it; no sigma."""

    def __init__(self, background: NDArray[np.uint8], axis: Literal["pca", "ellipse"]) -> None:
        self._background = background.astype(np.float32)
        self._axis: Literal["pca", "ellipse"] = axis
        self._rotation = AxialRotation()
        self.last_mask: NDArray[np.uint8] = np.zeros(background.shape[:2], np.uint8)

    def process(self, frame: Frame) -> Estimate:
        """Largest region that differs from the no-contact image, an even change of light aside."""
        change = frame.image.astype(np.float32) - self._background
        change -= np.median(change[::8, ::8], axis=(0, 1))
        strength = cv2.GaussianBlur(np.abs(change).max(axis=2), (0, 0), BLUR_PX)
        levels = np.asarray(np.clip(strength, 0, 255), np.uint8)
        otsu, _ = cv2.threshold(levels, 0, 255, cv2.THRESH_OTSU)
        above = np.asarray(strength > max(otsu, LEAST_LEVELS), np.uint8)
        closed = np.asarray(cv2.morphologyEx(above, cv2.MORPH_CLOSE, _DISC), np.uint8)
        count, labels, stats, _ = cv2.connectedComponentsWithStats(closed)
        if count < 2:
            self.last_mask = np.zeros_like(closed)
            return self._rotation.estimate(frame, math.nan, 0, self._axis)
        largest = 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA]))
        self.last_mask = np.asarray(labels == largest, np.uint8)
        if self._axis == "ellipse":
            angle_deg = axis_of_ellipse(self.last_mask)
        else:
            y, x = np.nonzero(self.last_mask)
            angle_deg = axis_of_points(x, y)
        return self._rotation.estimate(frame, angle_deg, int(stats[largest, cv2.CC_STAT_AREA]), self._axis)
