"""Gel wear: how an untouched gel differs from its background image in light, light pattern and permanent marks.

Light drifts, and the camera moves by a pixel or two in its soft mount: both changes are smooth, or move what is there.
Wear is neither: worn paint or a cut leaves a new spot or line with sharp edges. So the image, averaged over many
frames, is compared with the darkest and brightest level that the known image has within a few pixels, after all smooth
differences are removed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

SMOOTH_PX = 4.0
"""Changes wider than this (one standard deviation) are light; marks are narrower, or have edges that are."""
SHIFT_PX = 2
"""Largest shift of the image on the sensor."""
FINE_PX = 0.8
"""Blur against the remaining noise; a mark of one pixel keeps half of its height."""
MARK_LEVELS = 6.0
"""Smallest height of a mark, gray levels, its colors together."""
MARK_NOISE = 6.0
"""Smallest height of a mark in standard deviations of the remaining noise."""
MARK_MIN_PX = 9
"""0.03 mm2: smaller ones are single pixels of the sensor."""
MARK_SHARE = 0.3
"""A mark extends to where it has this share of its height."""
GAINS = (0.5, 2.0)
"""Range of the change in brightness of the LEDs."""
KEPT_MARKS = 8
EDGE_PX = 4
"""Border of the image that is not checked: smoothing has data on one side only."""

Image = NDArray[np.uint8]
Mean = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class GelMark:
    """x_px, y_px: its center, right and down. levels: its largest height, gray levels.

    area_px: changed area on both sides of its edges; for a spot about one and a half times the spot.
    """

    x_px: float
    y_px: float
    area_px: int
    levels: float


@dataclass(frozen=True, slots=True)
class GelChange:
    """Change since the known image.

    level_bgr: increase in brightness, gray levels. uneven_levels: change of the light's pattern beyond that, r.m.s.
    marks: the strongest first, at most `KEPT_MARKS`. marked_px: area of all marks.
    """

    level_bgr: tuple[float, float, float]
    uneven_levels: float
    marks: tuple[GelMark, ...]
    marked_px: int


def compare_gel(now: Mean, now_frames: int, known: Image, noise_bgr: Sequence[float], known_frames: int) -> GelChange:
    """Compare an averaged image with the known one.

    Args:
        now: (320, 240, 3) float32 BGR, mean of `now_frames` untouched frames.
        now_frames: Number of frames in `now`.
        known: (320, 240, 3) uint8 BGR, mean of `known_frames`.
        noise_bgr: Standard deviation of one pixel, gray levels.
        known_frames: Number of frames in `known`.
    """
    difference = cv2.subtract(now, known.astype(np.float32))
    level = difference.mean(axis=(0, 1))
    smooth = cv2.GaussianBlur(difference, (0, 0), 3.0 * SMOOTH_PX)
    uneven = float(np.sqrt(np.square(smooth - level).mean()))
    left_std = np.sqrt(np.square(np.asarray(noise_bgr)) * (1.0 / now_frames + 1.0 / known_frames) + 1.0 / 12.0)
    marks, marked_px = _marks(now, known, float(np.linalg.norm(left_std)))
    return GelChange((float(level[0]), float(level[1]), float(level[2])), uneven, marks, marked_px)


def _marks(now: Mean, known: Image, left_std: float) -> tuple[tuple[GelMark, ...], int]:
    """Return sharp structures that the known image does not have within `SHIFT_PX`, and their total area."""
    current, then = _sharp(now), _sharp(known.astype(np.float32))
    then *= _gain(current, then)
    near = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * SHIFT_PX + 1, 2 * SHIFT_PX + 1))
    above = current - cv2.dilate(then, near)
    below = cv2.erode(then, near) - current
    beyond = np.maximum(np.maximum(above, below), 0.0)
    height = np.sqrt(np.square(beyond).sum(axis=2))
    height[:EDGE_PX], height[-EDGE_PX:], height[:, :EDGE_PX], height[:, -EDGE_PX:] = 0.0, 0.0, 0.0, 0.0
    found = (height > max(MARK_LEVELS, MARK_NOISE * left_std)).astype(np.uint8)
    count, labels, stats, centers = cv2.connectedComponentsWithStats(found, connectivity=8)
    marks = []
    for one in range(1, count):
        if stats[one, cv2.CC_STAT_AREA] < MARK_MIN_PX:
            continue
        levels = height[labels == one]
        strongest = float(levels.max())
        area_px = int(np.count_nonzero(levels >= MARK_SHARE * strongest))  # without the ring that smoothing draws
        marks.append(GelMark(float(centers[one][0]), float(centers[one][1]), area_px, strongest))
    marks.sort(key=lambda mark: mark.levels, reverse=True)
    return tuple(marks[:KEPT_MARKS]), sum(mark.area_px for mark in marks)


def _gain(current: Mean, then: Mean) -> NDArray[np.float32]:
    """Return the change in brightness of each color, (3,), from the gel's own specks and streaks."""
    both, alone = (current * then).sum(axis=(0, 1)), np.square(then).sum(axis=(0, 1))
    return np.asarray(np.clip(both / np.maximum(alone, 1.0), *GAINS), np.float32)


def _sharp(image: Mean) -> Mean:
    """Remove what is smooth, and the median of each column and row of the sensor."""
    fine = cv2.GaussianBlur(image, (0, 0), FINE_PX) - cv2.GaussianBlur(image, (0, 0), SMOOTH_PX)
    fine -= np.median(fine, axis=0, keepdims=True)
    fine -= np.median(fine, axis=1, keepdims=True)
    return np.asarray(fine, np.float32)
