"""Thinning equals OpenCV's Guo-Hall thinning, pixel by pixel."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from slipguard.perception.skeleton import thin

Mask = NDArray[np.uint8]


def reference(mask: Mask) -> Mask:
    gray = np.where(mask > 0, 255, 0).astype(np.uint8)
    return (cv2.ximgproc.thinning(gray, thinningType=cv2.ximgproc.THINNING_GUOHALL) > 0).astype(np.uint8)


def drawn(kind: int, rng: np.random.Generator, largest_px: int = 44) -> Mask:
    """One random mask: noise, blob, shapes, lines, or a shape pushed over the border."""
    height, width = (int(v) for v in rng.integers(1, largest_px, 2))
    if kind == 5:  # one row, one column
        height, width = (1, width) if rng.random() < 0.5 else (height, 1)
    if kind in (0, 5):
        return (rng.random((height, width)) < rng.uniform(0.05, 0.98)).astype(np.uint8)
    mask = np.zeros((height, width), np.uint8)
    if kind == 1:
        noise = cv2.GaussianBlur(rng.random((height, width)).astype(np.float32), (0, 0), rng.uniform(1, 4))
        return (noise > np.quantile(noise, rng.uniform(0.1, 0.9))).astype(np.uint8)
    for _ in range(int(rng.integers(1, 4))):
        center = (int(rng.integers(-2, width + 2)), int(rng.integers(-2, height + 2)))
        if kind == 2:
            axes = (int(rng.integers(1, 25)), int(rng.integers(1, 12)))
            cv2.ellipse(mask, center, axes, float(rng.uniform(0, 180)), 0, 360, 1, -1)
        elif kind == 3:
            corners = rng.integers(-6, largest_px + 6, (int(rng.integers(3, 7)), 2))
            cv2.fillPoly(mask, [corners.astype(np.int32)], 1)
        else:
            end = (int(rng.integers(0, width)), int(rng.integers(0, height)))
            cv2.line(mask, center, end, 1, int(rng.integers(1, 7)))
    if kind == 3 and rng.random() < 0.3:
        mask = 1 - mask
    return mask


@pytest.mark.parametrize("count", [600, pytest.param(10_000, marks=pytest.mark.campaign)])
def test_random_masks_are_thinned_as_opencv_thins_them(count: int) -> None:
    rng = np.random.default_rng(20240817)
    for index in range(count):
        mask = drawn(index % 6, rng)
        wrong = int((thin(mask) != reference(mask)).sum())
        assert wrong == 0, f"mask {index}, {mask.shape}: {wrong} pixels differ"


@pytest.mark.parametrize("size", [(120, 160), (240, 320)])
def test_full_frames_are_thinned_as_opencv_thins_them(size: tuple[int, int]) -> None:
    rng = np.random.default_rng(3)
    width, height = size
    for angle in (0, 20, 65, 90, 137):
        mask = np.zeros((height, width), np.uint8)
        box = cv2.boxPoints(((width / 2, height / 2), (width * 0.9, height * 0.2), float(angle)))
        cv2.fillPoly(mask, [box.astype(np.int32)], 1)
        mask ^= (rng.random(mask.shape) < 0.01).astype(np.uint8)
        np.testing.assert_array_equal(thin(mask), reference(mask))


def test_a_crop_padded_by_one_gives_the_crop_of_the_thinned_image() -> None:
    rng = np.random.default_rng(5)
    for index in range(200):
        crop = drawn(index % 5, rng)
        image = np.pad(crop, 9)
        np.testing.assert_array_equal(thin(np.pad(crop, 1))[1:-1, 1:-1], thin(image)[9:-9, 9:-9])


@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (7, 1), (2, 2), (3, 3)])
@pytest.mark.parametrize("value", [0, 1])
def test_smallest_images(shape: tuple[int, int], value: int) -> None:
    mask = np.full(shape, value, np.uint8)
    np.testing.assert_array_equal(thin(mask), reference(mask))


def test_accepts_bool_and_255_and_leaves_its_input_alone() -> None:
    mask = drawn(3, np.random.default_rng(1))
    before = mask.copy()
    np.testing.assert_array_equal(thin(mask > 0), thin(mask * np.uint8(255)))
    np.testing.assert_array_equal(mask, before)
