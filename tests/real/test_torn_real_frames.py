"""Torn frames spliced from real frames are found; no real frame is taken for torn after any other."""

from __future__ import annotations

from itertools import permutations
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from slipguard.perception.image_quality import find_tear
from slipguard.sim.sensor_unit import NOISE_STD_BGR, STRIPE_STD_BGR, CameraNoise
from slipguard.tools.image_files import read_bgr

pytestmark = pytest.mark.real
Image = NDArray[np.uint8]
CLEAR_LEVELS = 10.0
"""RMS difference of the two captures at the line, gray levels: such a tear must be found."""


def real_images(folder: Path) -> list[list[Image]]:
    """Return the real frames of each unit."""
    indenter, balls = folder / "anytouch2_force2", folder / "taxim_sphere"
    units = (
        [*sorted((indenter / "frames").glob("*.png")), indenter / "background.png"],
        sorted(balls.glob("*.png")),
        [*sorted((folder / "backgrounds").glob("*.png")), folder / "aurova" / "frame.png"],
    )
    return [[read_bgr(path) for path in paths] for paths in units]


def spliced(first: Image, second: Image, along: str, line: int) -> Image:
    """Return an image with the lines before `line` from the first one. along: "row" or "column"."""
    image = second.copy()
    part = (slice(0, line),) if along == "row" else (slice(None), slice(0, line))
    image[part] = first[part]
    return image


def half_size(image: Image) -> Image:
    """Return the image at 120 x 160."""
    return np.asarray(cv2.resize(image, (120, 160), interpolation=cv2.INTER_AREA), np.uint8)


def test_no_real_frame_is_taken_for_torn(real_data: Path) -> None:
    units = real_images(real_data)
    sizes = (*units, *([half_size(image) for image in unit] for unit in units))
    pairs = [pair for images in sizes for pair in permutations(images, 2)]
    assert len(pairs) > 9000
    tears = [find_tear(image, before) for before, image in pairs]
    assert [tear for tear in tears if tear is not None] == []


def test_tears_between_real_frames_are_found(real_data: Path) -> None:
    rng, noise = np.random.default_rng(1), CameraNoise(NOISE_STD_BGR, STRIPE_STD_BGR, 1)
    found = []
    for images in real_images(real_data)[:2]:
        for _ in range(30):
            first, second = (images[k] for k in rng.choice(len(images), 2, replace=False))
            previous = np.clip(np.rint(first + noise.next()), 0, 255).astype(np.uint8)
            difference = second.astype(np.float32) - first
            for along, count in (("row", 320), ("column", 240)):
                lines = difference if along == "row" else difference.transpose(1, 0, 2)
                smooth = cv2.blur(np.ascontiguousarray(lines), (9, 2))
                levels = np.sqrt(np.square(smooth - smooth.mean(axis=1, keepdims=True)).mean(axis=(1, 2)))
                clear = [line for line in range(10, count - 4, 20) if levels[line] > CLEAR_LEVELS]
                tears = [find_tear(spliced(first, second, along, line), previous) for line in clear]
                found += list(zip(tears, (f"{along} {line}" for line in clear), strict=True))
    assert len(found) > 100
    assert np.mean([tear is not None for tear, _ in found]) > 0.97
    assert np.mean([tear == at for tear, at in found]) > 0.9
