"""Frames without contact of real units: their background images with the light and the noise of another day."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.datasets.mask_scores import read_bgr
from tests.campaigns.real_frames import RealFrame

NOISE_BGR = (2.9, 1.5, 2.4)
"""Temporal noise of two real units, standard deviation in gray levels per channel."""
NOISE_BLUR_PX = 0.85
"""Gaussian blur that gives white noise the measured correlation of 0.65 between neighboring pixels."""
TUNING_BACKGROUNDS = 3


def another_day(background: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
    """Return a later frame without contact: each channel off by up to 5 gray levels, new camera noise."""
    white = rng.standard_normal(background.shape).astype(np.float32)
    noise = np.asarray(cv2.GaussianBlur(white, (0, 0), NOISE_BLUR_PX), np.float32)
    noise *= np.asarray(NOISE_BGR, np.float32) / noise.std((0, 1))
    light = rng.uniform(-5, 5, 3).astype(np.float32)
    return np.asarray(np.clip(np.rint(background + noise + light), 0, 255), np.uint8)


def no_contact_frames(folder: Path, days: int, seed: int = 0) -> list[RealFrame]:
    """Return `days` later frames without contact of each unit in `folder/backgrounds`, with its background image."""
    rng = np.random.default_rng(seed)
    nothing = np.zeros((320, 240), np.bool_)
    out = []
    for number, path in enumerate(sorted((folder / "backgrounds").glob("*.png"))):
        background = read_bgr(path)
        split = "tune" if number < TUNING_BACKGROUNDS else "test"
        for day in range(days):
            image = another_day(background, rng)
            out.append(RealFrame(f"{path.stem}-{day}", "backgrounds", split, image, background, nothing))
    return out
