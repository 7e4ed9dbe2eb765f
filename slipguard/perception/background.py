"""A unit's background image: its dead lines, how the gel differs from it later, and an estimate if it is unknown.

On a dead line the difference from the background image is zero, under a contact too. That is a sharp pattern which
stays in place while the contact rotates and holds the registration back, so dead lines are interpolated.

Light drifts, and the camera moves by a pixel or two in its soft mount: both changes are smooth, or move what is there.
Wear is neither: worn paint or a cut leaves a new spot or line with sharp edges. So an image averaged over many frames
is compared with the darkest and brightest level that the known image has within a few pixels, after all smooth
differences are removed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.perception.skipping import check_frame

DEAD_LEVELS = 16.0
"""A dead line differs by this much (gray levels, its colors together, median along it) from the lines on both sides.
Lines of 160 images of real gels differ by 11 at most, and a line stuck at the gel's own gray by 20 and more on most
units: it has no color."""
DEAD_TIMES = 2.5
"""A dead line also differs by this multiple of the median of all lines: an image of noise has no dead lines."""
NEIGHBORS_PX = (1, 2)
"""Two adjacent dead lines may be equal, so lines are also compared with the next but one. A sound line between a dead
one and the border counts as dead too."""
DEAD_SHARE_MAX = 0.25
"""With more dead lines than this the image is no image of the gel; it is left unchanged."""

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

ORDER = 4
"""Degree of the polynomial: the glow of three lamps on a dome, and little of any imprint."""
ITERATIONS = 6
GRID_WIDTH_PX, GRID_HEIGHT_PX = 30, 40
OUTLIER_FLOOR_LEVELS = 4.0
"""Residuals below this many gray levels (over B, G and R together) do not count as an imprint."""

Image = NDArray[np.uint8]
Mean = NDArray[np.float32]


class DeadLines:
    """The dead lines of one unit; none if the background image is unknown. background: (320, 240, 3) uint8."""

    def __init__(self, background: Image | None) -> None:
        self.rows: list[int] = []
        """Dead rows, from the top."""
        self.columns: list[int] = []
        """Dead columns, from the left."""
        if background is not None:
            check_frame(background)
            self.rows = _find_dead(background)
            self.columns = _find_dead(background.transpose(1, 0, 2))

    def interpolate(self, image: Image) -> Image:
        """Return the image with its dead lines interpolated; the same array if the unit has none.

        Raises:
            FrameCorrupt: There are lines to interpolate, and the array is no gel image.
        """
        if not (self.rows or self.columns):
            return image
        check_frame(image)
        repaired = image.copy()
        _fill(repaired, self.rows)
        _fill(repaired.transpose(1, 0, 2), self.columns)
        return repaired


def _find_dead(lines: Image) -> list[int]:
    """Return which of n lines, (n, m, 3) uint8, differ from those on both sides."""
    levels = lines.astype(np.int16)
    apart = np.zeros(len(levels))
    for away in NEIGHBORS_PX:
        steps = np.median(np.abs(levels[away:] - levels[:-away]).sum(axis=2), axis=1)
        edge = np.full(away, np.inf)
        apart = np.maximum(apart, np.minimum(np.append(edge, steps), np.append(steps, edge)))
    dead = np.flatnonzero(apart > max(DEAD_LEVELS, DEAD_TIMES * float(np.median(apart))))
    return dead.tolist() if len(dead) <= DEAD_SHARE_MAX * len(apart) else []


def _fill(lines: Image, dead: list[int]) -> None:
    """Overwrite the dead lines of (n, m, 3) from the nearest sound ones on both sides."""
    sound = np.setdiff1d(np.arange(len(lines)), dead)
    for line in dead:
        place = int(np.searchsorted(sound, line))
        before, after = sound[max(place - 1, 0)], sound[min(place, len(sound) - 1)]
        weight = min(max((line - before) / max(after - before, 1), 0.0), 1.0)
        lines[line] = np.rint((1.0 - weight) * lines[before] + weight * lines[after]).astype(np.uint8)


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


def _terms(width_px: int, height_px: int) -> NDArray[np.float64]:
    """Return monomials x^i y^j with i + j <= ORDER on an image spanning -1..1: (height * width, 15)."""
    y, x = np.mgrid[0:height_px, 0:width_px]
    x = ((x + 0.5) / width_px * 2.0 - 1.0).ravel()
    y = ((y + 0.5) / height_px * 2.0 - 1.0).ravel()
    return np.stack([x**i * y**j for i in range(ORDER + 1) for j in range(ORDER + 1 - i)], -1)


@cache
def _bases(width_px: int, height_px: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the terms, orthonormal on the fitting grid: on that grid, and at full size."""
    basis, triangle = np.linalg.qr(_terms(GRID_WIDTH_PX, GRID_HEIGHT_PX))
    full = _terms(width_px, height_px) @ np.linalg.inv(triangle)
    return basis.astype(np.float32), full.astype(np.float32)


def estimate_background(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return a smooth image that follows the gel's own glow and passes under the imprint.

    A quartic is fitted to each channel by least squares with weights 1 / (1 + (r / k)^4), where r is the residual over
    the channels and k is 1.5 times its median: an imprint on less than half of the image is left out. Streaks, dust and
    edges of the glow are not modeled, so the network sees them as differences: the unit's own background image is
    better.

    Args:
        image: (H, W, 3) uint8 BGR.

    Returns:
        The background, same shape and type.
    """
    height, width = image.shape[:2]
    basis, full = _bases(width, height)
    coarse = cv2.resize(image, (GRID_WIDTH_PX, GRID_HEIGHT_PX), interpolation=cv2.INTER_AREA)
    levels = coarse.reshape(-1, 3).astype(np.float32)
    weights = np.ones(len(levels), np.float32)
    ridge = 1e-4 * np.eye(basis.shape[1], dtype=np.float32)
    fit = np.zeros((basis.shape[1], 3), np.float32)
    for _ in range(ITERATIONS):
        weighted = basis * weights[:, None]
        fit = np.linalg.solve(basis.T @ weighted + ridge, weighted.T @ levels).astype(np.float32)
        residual = levels - basis @ fit
        distance = np.sqrt(np.einsum("ij,ij->i", residual, residual))
        scale = max(1.5 * float(np.median(distance)), OUTLIER_FLOOR_LEVELS)
        weights = (1.0 / (1.0 + (distance / scale) ** 4)).astype(np.float32)
    smooth = np.clip(full @ fit, 0.0, 255.0)
    return np.asarray(smooth.reshape(height, width, 3), np.uint8)
