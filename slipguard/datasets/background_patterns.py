"""Procedural patterns of a real gel without contact: training with them teaches the network to ignore them.

Two kinds, as (160, 120, 3) float arrays in relative levels: `structure` is always visible on a unit (edges of the glow,
streaks, dust, patches, sensor columns); `drift` is the difference of a frame to the background image without contact
(moved glow edges, a new streak, column noise, slow patches). Real DIGITs show all of them: between two days the edge of
the red glow moves by a few pixels, and column patterns appear and disappear.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.perception.segmenter import INPUT_HEIGHT_PX as H
from slipguard.perception.segmenter import INPUT_WIDTH_PX as W

Pattern = NDArray[np.float32]
SUBPIXEL_BITS = 3


def patterns(kind: Callable[[np.random.Generator], Pattern], count: int, seed: int) -> NDArray[np.float16]:
    """Return `count` patterns of one kind, (count, 160, 120, 3) float16, deterministic for the seed."""
    rng = np.random.default_rng(seed)
    return np.stack([kind(rng).astype(np.float16) for _ in range(count)])


def structure(rng: np.random.Generator) -> Pattern:
    """Return the permanent pattern of one unit's gel, standard deviation about 1."""
    field = np.zeros((H, W, 3), np.float32)
    if rng.random() < 0.7:
        field += _edges(rng, int(rng.integers(1, 4)))
    if rng.random() < 0.6:
        field += 0.7 * _streaks(rng, int(rng.integers(1, 7)), thickness=(1, 10), blur=(1.5, 6.0))
    if rng.random() < 0.5:
        field += 0.7 * _patches(rng, (int(rng.integers(3, 7)), int(rng.integers(3, 6))))
    if rng.random() < 0.4:
        field += _dust(rng, int(rng.integers(1, 5)))
    if rng.random() < 0.3:
        field += 0.1 * _columns(rng)
    return np.asarray(field / max(float(field.std()), 0.3), np.float32)


def drift(rng: np.random.Generator) -> Pattern:
    """Return the difference of a frame without contact to the background image, largest value about 1."""
    field = np.zeros((H, W, 3), np.float32)
    if rng.random() < 0.6:
        field += _streaks(rng, int(rng.integers(1, 4)), thickness=(1, 6), blur=(0.8, 4.0))
    if rng.random() < 0.5:
        field += 1.2 * _moved_edges(rng, int(rng.integers(1, 3)))
    if rng.random() < 0.3:
        field += 0.6 * _edges(rng, int(rng.integers(1, 3)))
    if rng.random() < 0.6:
        field += 0.5 * _patches(rng, (int(rng.integers(2, 5)), int(rng.integers(2, 4))))
    if rng.random() < 0.6:
        field += 0.4 * _columns(rng)
    if rng.random() < 0.2:
        field += _dust(rng, int(rng.integers(1, 3)))
    return np.asarray(field / max(float(np.abs(field).max()), 0.3), np.float32)


def _tint(rng: np.random.Generator) -> Pattern:
    """Return a color change; half of them are mostly gray."""
    color = rng.standard_normal(3)
    if rng.random() < 0.5:
        color = 0.35 * color + rng.standard_normal()
    return color.astype(np.float32)


def _curve(rng: np.random.Generator) -> NDArray[np.float64]:
    """Return the points of a smooth curve that starts near the image: (n, 2) x, y."""
    start = rng.uniform(0.0, 2.0 * np.pi)
    at = np.array([W / 2, H / 2]) + np.array([np.cos(start), np.sin(start)]) * rng.uniform(0.0, 70.0)
    count = int(rng.integers(20, 110))
    bend = rng.normal(0.0, 0.02) + np.cumsum(rng.normal(0.0, 0.004, count))
    heading = rng.uniform(0.0, 2.0 * np.pi) + np.cumsum(bend)
    return at + np.cumsum(2.0 * np.stack([np.cos(heading), np.sin(heading)], -1), 0)


def _fixed(points: NDArray[np.float64]) -> list[NDArray[np.int32]]:
    return [np.rint(points * 2**SUBPIXEL_BITS).astype(np.int32)]


def _blurred(field: Pattern, sigma_px: float) -> Pattern:
    return np.asarray(cv2.GaussianBlur(field, (0, 0), sigma_px), np.float32)


def _streaks(rng: np.random.Generator, count: int, thickness: tuple[int, int], blur: tuple[float, float]) -> Pattern:
    field = np.zeros((H, W, 3), np.float32)
    for _ in range(count):
        line = np.zeros((H, W), np.float32)
        width = int(rng.integers(*thickness))
        cv2.polylines(line, _fixed(_curve(rng)), False, (1.0,), width, cv2.LINE_AA, SUBPIXEL_BITS)
        line = _blurred(line, rng.uniform(*blur))
        field += (line / max(float(line.max()), 0.05))[..., None] * _tint(rng)
    return field


def _wavy_ring(rng: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Return center (x, y), points relative to it, and size of a wavy closed curve wider than most of the view."""
    center = np.array([W / 2, H / 2]) + rng.normal(0.0, 1.0, 2) * [90.0, 110.0]
    rotation = np.linspace(0.0, 2.0 * np.pi, 60)
    wave = 1.0 + 0.15 * np.sin(rotation * rng.integers(1, 4) + rng.uniform(0.0, 6.0))
    size = rng.uniform(40.0, 200.0)
    return center, np.stack([np.cos(rotation), np.sin(rotation)], -1) * wave[:, None] * size, size


def _region(points: NDArray[np.float64], blur_px: float) -> Pattern:
    region = np.zeros((H, W), np.float32)
    cv2.fillPoly(region, _fixed(points), (1.0,), cv2.LINE_AA, SUBPIXEL_BITS)
    return _blurred(region, blur_px)


def _edges(rng: np.random.Generator, count: int) -> Pattern:
    """Return borders of large lit regions, blurred by 1 to 8 px."""
    field = np.zeros((H, W, 3), np.float32)
    for _ in range(count):
        center, ring, _ = _wavy_ring(rng)
        region = _region(center + ring, rng.uniform(1.0, 8.0))
        fade = 0.7 + 0.5 * _patches(rng, (4, 3))[..., :1]
        field += (region - region.mean())[..., None] * fade * _tint(rng)
    return field


def _moved_edges(rng: np.random.Generator, count: int) -> Pattern:
    """Return bands where the border of a lit region has moved by 1 to 12 px."""
    field = np.zeros((H, W, 3), np.float32)
    for _ in range(count):
        center, ring, size = _wavy_ring(rng)
        blur_px = rng.uniform(1.5, 5.0)
        moved = center + rng.normal(0.0, 2.5, 2) + ring * (1.0 + rng.uniform(-6.0, 6.0) / size)
        band = _region(moved, blur_px) - _region(center + ring, blur_px)
        fade = np.maximum(0.7 + 0.5 * _patches(rng, (4, 3))[..., :1], 0.0)
        field += (band / max(float(np.abs(band).max()), 0.05))[..., None] * fade * _tint(rng)
    return field


def _patches(rng: np.random.Generator, cells: tuple[int, int]) -> Pattern:
    coarse = rng.standard_normal((*cells, 3)).astype(np.float32)
    return np.asarray(cv2.resize(coarse, (W, H), interpolation=cv2.INTER_CUBIC), np.float32)


def _columns(rng: np.random.Generator) -> Pattern:
    """Return fixed-pattern noise of the sensor's columns (rows in one of ten), of varying strength."""
    along = W if rng.random() < 0.9 else H
    line = _blurred(rng.standard_normal((1, along, 3)).astype(np.float32), rng.uniform(0.4, 2.0))
    line = line.reshape(1, along, 3) / line.std()
    strength = 0.4 + 0.6 * np.abs(_patches(rng, (4, 3))[..., :1])
    return np.asarray((line if along == W else line.transpose(1, 0, 2)) * strength, np.float32)


def _dust(rng: np.random.Generator, count: int) -> Pattern:
    field = np.zeros((H, W, 3), np.float32)
    for _ in range(count):
        spot = np.zeros((H, W), np.float32)
        center = (int(rng.integers(W)), int(rng.integers(H)))
        cv2.circle(spot, center, int(rng.integers(0, 3)), (1.0,), -1, cv2.LINE_AA)
        field += _blurred(spot, rng.uniform(0.4, 1.2))[..., None] * _tint(rng)
    return field
