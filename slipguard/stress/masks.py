"""Masks that are hard for estimators, by name."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Mask = NDArray[np.uint8]
WIDTH, HEIGHT = 120, 160


def degenerate_masks() -> dict[str, Mask]:
    """Return masks by name: (160, 120) uint8, 0 or 1; one is (320, 240), with 10,000 components."""
    masks = {"empty": _empty(), "full": _empty() + 1}
    masks |= _points() | _lines() | _patterns() | _solids()
    return {name: np.asarray(mask, np.uint8) for name, mask in masks.items()}


def _empty() -> Mask:
    return np.zeros((HEIGHT, WIDTH), np.uint8)


def _at(*places: tuple[slice | int, slice | int]) -> Mask:
    mask = _empty()
    for rows, columns in places:
        mask[rows, columns] = 1
    return mask


def _points() -> dict[str, Mask]:
    return {
        "one pixel": _at((80, 60)),
        "pixel in the corner": _at((0, 0)),
        "pixel on the edge": _at((0, 60)),
        "two pixels": _at((80, 60), (80, 61)),
        "two far pixels": _at((0, 0), (159, 119)),
        "two pixels, corner to corner": _at((80, 60), (81, 61)),
        "four corners": _at((0, 0), (0, -1), (-1, 0), (-1, -1)),
        "39 pixels": _at((slice(80, 83), slice(50, 63))),
        "40 pixels": _at((slice(80, 84), slice(50, 60))),
        "41 pixels": _at((slice(80, 84), slice(50, 60)), (84, 50)),
        "50 pixels": _at((slice(80, 85), slice(50, 60))),
        "2 x 2": _at((slice(80, 82), slice(60, 62))),
        "3 x 3": _at((slice(80, 83), slice(60, 63))),
    }


def _lines() -> dict[str, Mask]:
    whole = slice(None)
    masks = {
        "row": _at((80, whole)),
        "top row": _at((0, whole)),
        "bottom row": _at((-1, whole)),
        "two rows": _at((slice(80, 82), whole)),
        "three rows": _at((slice(80, 83), whole)),
        "column": _at((whole, 60)),
        "left column": _at((whole, 0)),
        "right column": _at((whole, -1)),
        "short row": _at((80, slice(20, 100))),
        "short column": _at((slice(20, 140), 60)),
        "short two rows": _at((slice(80, 82), slice(20, 100))),
        "frame's border": _at((0, whole), (-1, whole), (whole, 0), (whole, -1)),
        "border 5 wide": 1 - _at((slice(5, -5), slice(5, -5))),
        "crosshairs": _at((80, whole), (whole, 60)),
        "L along the edges": _at((0, whole), (whole, 0)),
    }
    for width in (1, 2, 3):
        for name, ends in (("diagonal", ((0, 0), (119, 159))), ("steep", ((55, 10), (65, 150)))):
            masks[f"{name} {width}"] = np.asarray(cv2.line(_empty(), ends[0], ends[1], 1, width), np.uint8)
    return masks


def _patterns() -> dict[str, Mask]:
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH]
    tall, wide = np.mgrid[0:320, 0:240]
    components = ((tall % 3 == 0) & (wide % 2 == 0)).astype(np.uint8)
    components[:, 1::2] = 0
    r = np.hypot(x - 60.0, y - 80.0)
    spiral = (np.sin(r / 2.5 + np.arctan2(y - 80.0, x - 60.0)) > 0.3) & (r < 55)
    return {
        "checkerboard 1": ((x + y) % 2).astype(np.uint8),
        "checkerboard 2": ((x // 2 + y // 2) % 2).astype(np.uint8),
        "checkerboard 7": ((x // 7 + y // 7) % 2).astype(np.uint8),
        "stripes across": (y % 2).astype(np.uint8),
        "stripes along": (x % 2).astype(np.uint8),
        "oblique stripes": ((x + 2 * y) // 9 % 2).astype(np.uint8),
        "grid of dots": ((x % 2 == 0) & (y % 2 == 0)).astype(np.uint8),
        "grid of blobs": ((x % 10 < 6) & (y % 10 < 6)).astype(np.uint8),
        "10,000 components": components,
        "comb": ((y > 120) | (x % 2 == 0)).astype(np.uint8),
        "spiral": spiral.astype(np.uint8),
        "rings": ((r.astype(int) // 4) % 2).astype(np.uint8),
        "stairs": (np.abs(x // 8 * 10 - y) < 12).astype(np.uint8),
    }


def _solids() -> dict[str, Mask]:
    hole = _empty() + 1
    hole[80, 60] = 0
    two_halves = _empty() + 1
    two_halves[78:82] = 0
    return {
        "full but one pixel": hole,
        "full but the border": _at((slice(1, -1), slice(1, -1))),
        "two halves": two_halves,
        "left half": _at((slice(None), slice(0, 60))),
        "top half": _at((slice(0, 80), slice(None))),
        "quarter in the corner": _at((slice(0, 80), slice(0, 60))),
        "square": _at((slice(60, 100), slice(40, 80))),
        "disc": np.asarray(cv2.circle(_empty(), (60, 80), 30, 1, -1), np.uint8),
        "half disc at the edge": np.asarray(cv2.circle(_empty(), (0, 80), 30, 1, -1), np.uint8),
        "quarter disc in the corner": np.asarray(cv2.circle(_empty(), (0, 0), 40, 1, -1), np.uint8),
        "thin ring": np.asarray(cv2.circle(_empty(), (60, 80), 40, 1, 1), np.uint8),
        "bar": _at((slice(70, 90), slice(20, 100))),
        "bar across the frame": _at((slice(70, 90), slice(None))),
        "bar along the edge": _at((slice(20, 140), slice(0, 8))),
        "bar 3 from the edge": _at((slice(20, 140), slice(3, 11))),
        "cross": _at((slice(70, 90), slice(20, 100)), (slice(40, 120), slice(50, 70))),
        "two equal solids": _at((slice(20, 50), slice(20, 50)), (slice(110, 140), slice(70, 100))),
        "solid and fragments": _at((slice(40, 90), slice(40, 60)), *[(k, k) for k in range(100, 119, 3)]),
    }
