"""How an untouched gel has changed since its no-contact image was taken: the light, its pattern, and lasting marks.

Light drifts and the camera moves by a pixel or two in its soft mount; both are smooth, or move what is there. Wear is
neither: where paint has gone or the gel is cut there is a spot or a line with sharp edges that was not there before.
So the picture, averaged over many frames, is compared with the darkest and brightest that the known picture shows
within a few pixels, after all that is smooth in the difference has been taken out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.perception.contact.gate import BLOCKS_HIGH, BLOCKS_WIDE, ContactGate, block_means

SMOOTH_PX = 4.0
"""Changes wider than this (one standard deviation) are light; marks are narrower, or have edges that are."""
SHIFT_PX = 2
"""How far the picture may have moved on the sensor."""
FINE_PX = 0.8
"""Averages what noise is left; a mark of one pixel keeps half of its height."""
MARK_LEVELS = 6.0
"""A mark stands out by this many grey levels at least, its colours together."""
MARK_NOISE = 6.0
"""... and by this many standard deviations of what noise is left."""
MARK_MIN_PX = 9
"""0.03 mm2: smaller ones are single pixels of the sensor."""
MARK_SHARE = 0.3
"""A mark reaches to where it has this share of its height."""
GAINS = (0.5, 2.0)
"""Lamps may be set to something else; what would be stronger or weaker than this is no light."""
KEPT_MARKS = 8
EDGE_PX = 4
"""The border of the picture, where smoothing knows one side only."""

Image = NDArray[np.uint8]
Mean = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class GelMark:
    """x_px, y_px: its middle, right and down. levels: how far it stands out at its strongest, grey levels.

    area_px: what it changes, on both sides of its edges; for a spot about one and a half times the spot.
    """

    x_px: float
    y_px: float
    area_px: int
    levels: float


@dataclass(frozen=True, slots=True)
class GelChange:
    """Since the known picture. level_bgr: brighter by so many grey levels. uneven_levels: what the light's pattern has
    changed beyond that, root mean square. gate_share: how far of the way it is to where the gate takes light for
    touch, 1 there. marks: the strongest first, at most `KEPT_MARKS`. marked_px: of all of them.
    """

    level_bgr: tuple[float, float, float]
    uneven_levels: float
    gate_share: float
    marks: tuple[GelMark, ...]
    marked_px: int


def compare_gel(
    now: Mean, now_frames: int, known: Image, noise_bgr: Sequence[float], known_frames: int, gate_sigma: float
) -> GelChange:
    """Compare an averaged picture with the known one.

    now: (320, 240, 3) float32 BGR, mean of `now_frames` untouched frames. known: uint8, mean of `known_frames`.
    noise_bgr: standard deviation of one pixel. gate_sigma: as the gate is set.
    """
    difference = cv2.subtract(now, known.astype(np.float32))
    level = difference.mean(axis=(0, 1))
    smooth = cv2.GaussianBlur(difference, (0, 0), 3.0 * SMOOTH_PX)
    uneven = float(np.sqrt(np.square(smooth - level).mean()))
    left_std = np.sqrt(np.square(np.asarray(noise_bgr)) * (1.0 / now_frames + 1.0 / known_frames) + 1.0 / 12.0)
    marks, marked_px = _marks(now, known, float(np.linalg.norm(left_std)))
    return GelChange(
        (float(level[0]), float(level[1]), float(level[2])),
        uneven,
        _gate_share(now, known, noise_bgr, gate_sigma),
        marks,
        marked_px,
    )


def _marks(now: Mean, known: Image, left_std: float) -> tuple[tuple[GelMark, ...], int]:
    """What is sharp, and neither in the known picture nor next to where it is."""
    seen, then = _sharp(now), _sharp(known.astype(np.float32))
    then *= _gain(seen, then)
    near = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * SHIFT_PX + 1, 2 * SHIFT_PX + 1))
    above = seen - cv2.dilate(then, near)
    below = cv2.erode(then, near) - seen
    beyond = np.maximum(np.maximum(above, below), 0.0)
    height = np.sqrt(np.square(beyond).sum(axis=2))
    height[:EDGE_PX], height[-EDGE_PX:], height[:, :EDGE_PX], height[:, -EDGE_PX:] = 0.0, 0.0, 0.0, 0.0
    found = (height > max(MARK_LEVELS, MARK_NOISE * left_std)).astype(np.uint8)
    count, labels, facts, middles = cv2.connectedComponentsWithStats(found, connectivity=8)
    marks = []
    for one in range(1, count):
        if facts[one, cv2.CC_STAT_AREA] < MARK_MIN_PX:
            continue
        levels = height[labels == one]
        strongest = float(levels.max())
        area_px = int(np.count_nonzero(levels >= MARK_SHARE * strongest))  # without the ring that smoothing draws
        marks.append(GelMark(float(middles[one][0]), float(middles[one][1]), area_px, strongest))
    marks.sort(key=lambda mark: mark.levels, reverse=True)
    return tuple(marks[:KEPT_MARKS]), sum(mark.area_px for mark in marks)


def _gain(seen: Mean, then: Mean) -> NDArray[np.float32]:
    """How much stronger each colour's light is now: what it shows of the gel's own specks and streaks, (3,)."""
    both, alone = (seen * then).sum(axis=(0, 1)), np.square(then).sum(axis=(0, 1))
    return np.asarray(np.clip(both / np.maximum(alone, 1.0), *GAINS), np.float32)


def _sharp(picture: Mean) -> Mean:
    """Without what is smooth, and without what whole columns and rows of the sensor have in common."""
    fine = cv2.GaussianBlur(picture, (0, 0), FINE_PX) - cv2.GaussianBlur(picture, (0, 0), SMOOTH_PX)
    fine -= np.median(fine, axis=0, keepdims=True)
    fine -= np.median(fine, axis=1, keepdims=True)
    return np.asarray(fine, np.float32)


def _gate_share(now: Mean, known: Image, noise_bgr: Sequence[float], gate_sigma: float) -> float:
    """The worst block of the gate's own comparison, over the gate's limit."""
    gate = ContactGate(known, noise_bgr, gate_sigma)
    blocks = block_means(np.clip(np.rint(now), 0, 255).astype(np.uint8))
    assert gate.background is not None
    difference = blocks - gate.background
    y, x = np.divmod(np.arange(len(blocks)), BLOCKS_WIDE)
    terms = np.stack([np.ones(len(blocks)), x / BLOCKS_WIDE, y / BLOCKS_HIGH], axis=1).astype(np.float32)
    plane, *_ = np.linalg.lstsq(terms, difference, rcond=None)
    worst = np.linalg.norm((difference - terms @ plane) * gate.per_std, axis=1).max()
    return float(worst / gate_sigma)
