"""Frames of a drawn contact, and a segmenter that reads the contact off the blue channel."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.devices import Frame

BACKGROUND = np.full((320, 240, 3), 90, np.uint8)


class ReadsBlue:
    """Probability = how far the blue channel is above 100."""

    threshold = 0.5
    input_size = (120, 160)

    def __init__(self) -> None:
        self.calls = 0

    def segment(self, image: NDArray[np.uint8], background: NDArray[np.uint8] | None) -> NDArray[np.float32]:
        self.calls += 1
        blue = cv2.resize(image[..., 0], (120, 160), interpolation=cv2.INTER_AREA)
        return np.clip((blue.astype(np.float32) - 100.0) / 100.0, 0.0, 1.0)


def frame(probability: NDArray[np.float32] | None, k: int, seed: int = 0, captured_at_s: float | None = None) -> Frame:
    image = BACKGROUND.astype(np.float32)
    if probability is not None:
        image[..., 0] += 110.0 * cv2.resize(probability, (240, 320), interpolation=cv2.INTER_LINEAR)
    image += np.random.default_rng([seed, k]).normal(0.0, 1.0, image.shape)
    at = k / 60 if captured_at_s is None else captured_at_s
    return Frame(np.clip(image, 0, 255).astype(np.uint8), at, k)
