"""Frames without contact of real units: their background images with the light and the noise of another day."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.tools.image_files import read_bgr
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


def stale(background: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
    """Return a frame without contact long after the background image.

    The light differs by up to 10 gray levels per channel and by up to 6 more in slope and curvature, the camera has
    moved by up to 1.5 pixels in its mount, one to four specks of dirt are new, and up to 20 pixels are dead.
    """
    height, width = background.shape[:2]
    moved = np.array([[1.0, 0.0, rng.uniform(-1.5, 1.5)], [0.0, 1.0, rng.uniform(-1.5, 1.5)]])
    image = cv2.warpAffine(background, moved, (width, height), borderMode=cv2.BORDER_REPLICATE).astype(np.float32)
    y, x = np.mgrid[-1.0 : 1.0 : height * 1j, -1.0 : 1.0 : width * 1j]
    for channel in range(3):
        slope_x, slope_y, bend_x, bend_y = rng.uniform(-1.0, 1.0, 4)
        uneven = slope_x * x + slope_y * y + 0.5 * bend_x * x * x + 0.5 * bend_y * y * y
        image[..., channel] += rng.uniform(0.0, 6.0) * uneven / np.abs(uneven).max()
    for _ in range(rng.integers(1, 5)):
        speck = np.zeros((height, width), np.float32)
        at = (int(rng.integers(width)), int(rng.integers(height)))
        cv2.circle(speck, at, int(rng.integers(1, 5)), (1.0,), -1)
        image *= 1.0 - cv2.GaussianBlur(speck, (0, 0), 1.0)[..., None] * rng.uniform(0.1, 0.4)
    dead = int(rng.integers(20))
    image[rng.integers(0, height, dead), rng.integers(0, width, dead)] = rng.choice([0.0, 255.0], (dead, 1))
    even = np.clip(np.rint(image + rng.uniform(-5.0, 5.0, 3)), 0, 255).astype(np.uint8)
    return another_day(even, rng)


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
