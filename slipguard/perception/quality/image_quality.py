"""Image quality: rejects images of a contact on which a rotation estimate would be wrong without a larger sigma.

Rejected are images that are not of this unit's gel, out of focus, too dark, coarsely compressed, with too few gray
levels or too noisy. Sharp structures that stay in place while the contact rotates hold the texture registration back:
edges of compression blocks, steps between few gray levels. No sigma can account for that.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slipguard.perception.contact.gate import BLACK_LEVEL, BLOCKS_HIGH, BLOCKS_WIDE, WHITE_LEVEL, Blocks, block_means
from slipguard.perception.declined import DeclineReason, explain

UNLIKE_LEVELS = 8.0
"""Away from the contact a frame differs from the background image, apart from an even change of light, by 1-3 gray
levels on average, by 4.3 in the worst real lighting drift; swapped colors and a failing lamp give 9 and more."""
OUTSIDE_MIN = 120
"""Fewer blocks than this outside the contact (a tenth of the frame) show neither its contour nor the light."""
BRIGHTER_LEVELS = 30.0
"""Even change of a color's light, gray levels; real and rendered drifts reach 6. The network was trained on no more
than a few times that."""
BLOCK_STEP_LEVELS = 4.0
"""Mean difference from block to block away from the contact, gray levels: 1-2.3 in real frames, 4.6 if a pixel's
noise is 32."""
SWAPPED_MARGIN = 0.08
"""If the colors are swapped, another order of the channels correlates better with the background image, the three
correlations added up, by 0.1 and more (99 % of rendered frames); if not, worse by at least 0.04."""
_ORDERS = np.array([[3 * k + c for k, c in enumerate(order)] for order in itertools.permutations(range(3))])
"""The six orders of three channels, as indices into a 3 x 3 table; the right one first."""
CLIPPED_SHARE = 0.02
"""A contact with more of its blocks all black or all white lies under a glare or a dead spot that hides its contour.
If more pixels of the background image are at the end of a color's range, a contact shows edges that stay while it
rotates; nine real units have none."""
FINE_SHARE = 0.7
"""An image with less of its background image's unevenness (from block to block, away from the contact) is out of
focus: the gel's own pattern, which does not move, then outweighs a faint contact. 0.87 and more in real frames, 1.02
and more in rendered ones of many units; 0.3-0.5, on gels with little pattern up to 0.75, under a blur of 9 pixels."""
FINE_MIN = 60
"""Fewer blocks than this away from the contact are not enough for the test of focus."""
DARK_LEVELS = 25.0
"""Mean gray level of the image. Real gels have 90 and more; at 9, with the three lights on a few levels, the texture
rotates back by a fifth."""

COMPRESSION_BLOCK_PX = 8
"""Blocks of JPEG and motion JPEG; 240 and 320 are whole multiples of them, however the sensor is mounted."""
LINE_STEP_PX = 4
"""Step in rows and columns between the pixels tested for compression and gray levels."""
BLOCKINESS_MAX = 4.0
"""Curvature across block borders over that inside blocks: 4.3 and more at JPEG quality 23 on 60 rendered units.
Images that were never compressed have 0.7-1.5, real gels included; at the quality of motion JPEG (75 and better) 3.1 at
most; at 60, 3.7."""
BLOCKINESS_FLOOR_LEVELS = 0.05
"""Smallest curvature inside blocks, gray levels: an image without any detail is flatter."""

LEVEL_PIXELS_MIN = 5
"""A gray level is in use if this many of the 4,800 tested pixels have it: hot pixels fill no gap."""
LEVEL_STEP_MAX = 12.0
"""Mean step between the gray levels in use: 1.0-1.8 in real gels and in 60 rendered units, 6 if light four times as
bright has clipped most of it; 32, and sometimes 16, hold rotations back."""

NOISE_ROW_STEP_PX = 16
NOISE_LEVELS = 16.0
"""Median second difference along a row for white noise with a standard deviation of ten gray levels (1.65 times it);
2 in real frames of nine units and in forty rendered ones. Edges are too few to count."""


@dataclass(frozen=True, slots=True)
class QualityReport:
    """difference_levels: mean difference from the background image away from the contact, gray levels.

    declined: None, or why no rotation may be measured on the image.
    """

    difference_levels: float
    declined: str | None


class ImageQuality:
    """Checks images of a contact against one unit's background image.

    Args:
        background: (320, 240, 3) uint8 BGR, or None: then neither light, color order nor focus are checked.
    """

    def __init__(self, background: NDArray[np.uint8] | None) -> None:
        self._background = None if background is None else block_means(background)
        self._clipped = None if background is None else _clipped_share(background)
        if self._background is not None:
            self._fine = _unevenness(self._background)

    def check(self, image: NDArray[np.uint8], blocks: Blocks, near: NDArray[np.bool_]) -> QualityReport:
        """Return whether a rotation may be measured.

        Args:
            image: (320, 240, 3) uint8 BGR.
            blocks: (1200, 3) float32, its block means.
            near: (1200,) bool, the blocks in and around the contact.
        """
        report = self.check_blocks(blocks, near)
        if report.declined is not None:
            return report
        declined = None
        if blocks.mean() < DARK_LEVELS:
            detail = f"mean {blocks.mean():.0f} gray levels, minimum {DARK_LEVELS:.0f}; check the LEDs"
            declined = explain(DeclineReason.DARK, detail)
        elif is_coarsely_compressed(image):
            detail = f"blockiness above {BLOCKINESS_MAX:g}; use a JPEG quality of at least 75"
            declined = explain(DeclineReason.COMPRESSED, detail)
        elif has_few_levels(image):
            detail = f"mean step above {LEVEL_STEP_MAX:g} gray levels; check exposure and gain"
            declined = explain(DeclineReason.FEW_LEVELS, detail)
        elif is_noisy(image):
            detail = f"half of all second differences above {NOISE_LEVELS:g} gray levels; check light and gain"
            declined = explain(DeclineReason.NOISY, detail)
        return QualityReport(report.difference_levels, declined)

    def check_blocks(self, blocks: Blocks, near: NDArray[np.bool_]) -> QualityReport:
        """Return whether an image shows this unit's gel, in focus; arguments as in `check`."""
        difference_levels = self.difference_levels(blocks, near)
        declined = None
        if not math.isfinite(difference_levels):
            detail = "not this unit's gel in its usual light; check the light or calibrate again"
            declined = explain(DeclineReason.UNLIKE_BACKGROUND, detail)
        elif self.out_of_focus(blocks, near):
            detail = f"less than {FINE_SHARE:.0%} of the background image's detail; check the focus and the gel"
            declined = explain(DeclineReason.OUT_OF_FOCUS, detail)
        return QualityReport(difference_levels, declined)

    def difference_levels(self, blocks: Blocks, near: NDArray[np.bool_]) -> float:
        """Return the mean difference from the background image away from the contact, gray levels.

        An even change of light does not count: 1-3 in good light. Infinite if the image is not one of this unit's gel,
        or if the contact is black or white. Without a background image light and color order cannot be checked: then 0.
        """
        outside = (~near).astype(np.float32)
        count = float(outside.sum())
        if count < OUTSIDE_MIN:
            return math.inf
        if blocks.max() > WHITE_LEVEL or blocks.min() < BLACK_LEVEL:
            contact = blocks[near]
            clipped = (contact > WHITE_LEVEL).all(axis=1) | (contact < BLACK_LEVEL).all(axis=1)
            if np.count_nonzero(clipped) > CLIPPED_SHARE * len(contact):
                return math.inf
        if self._background is None:
            return 0.0
        if self._clipped is not None and self._clipped[near].mean(axis=0).max() > CLIPPED_SHARE:
            return math.inf
        difference = blocks - self._background
        brighter = (outside @ difference) / count
        if np.abs(brighter).max() > BRIGHTER_LEVELS:
            return math.inf
        levels = float((outside @ np.abs(difference - brighter)).sum()) / (3.0 * count)
        if levels > UNLIKE_LEVELS:
            return math.inf
        pairs = outside[1:] * outside[:-1]
        steps = np.abs(difference[1:] - difference[:-1])
        if float((pairs @ steps).sum()) >= 3.0 * BLOCK_STEP_LEVELS * float(pairs.sum()):
            return math.inf
        return math.inf if _colors_swapped(blocks, self._background, outside / count) else levels

    def out_of_focus(self, blocks: Blocks, near: NDArray[np.bool_]) -> bool:
        """Return whether an image shows far less of the gel's pattern than the background image does.

        Less light also shows less of it, which is allowed for. False if too little lies outside the contact, and
        without a background image.
        """
        if self._background is None:
            return False
        away = ~near
        outside = (away[: -2 * BLOCKS_WIDE] & away[BLOCKS_WIDE:-BLOCKS_WIDE] & away[2 * BLOCKS_WIDE :]).astype(
            np.float32
        )
        if float(outside.sum()) < FINE_MIN:
            return False
        middle = slice(BLOCKS_WIDE, -BLOCKS_WIDE)
        light = float((outside @ blocks[middle]).sum()) / max(float((outside @ self._background[middle]).sum()), 1.0)
        now, before = float((outside @ _unevenness(blocks)).sum()), float((outside @ self._fine).sum())
        return now < FINE_SHARE * min(light, 1.0) * before


def is_coarsely_compressed(image: NDArray[np.uint8]) -> bool:
    """Return whether rows and columns both break at block borders. image: (320, 240, 3) uint8 BGR."""
    green = image[..., 1]
    if blockiness(green[::LINE_STEP_PX].astype(np.int16)) <= BLOCKINESS_MAX:
        return False
    return blockiness(green[:, ::LINE_STEP_PX].T.astype(np.int16)) > BLOCKINESS_MAX


def blockiness(lines: NDArray[np.int16]) -> float:
    """Return the mean third difference across block borders over that inside blocks; 1 without blocks.

    A third difference vanishes wherever the light changes evenly. lines: (n, m) int16, along the second axis.
    """
    across = _third_difference(lines, COMPRESSION_BLOCK_PX - 2)
    return across / max(_third_difference(lines, COMPRESSION_BLOCK_PX // 2 - 2), BLOCKINESS_FLOOR_LEVELS)


def _third_difference(lines: NDArray[np.int16], first: int) -> float:
    """Return the mean, gray levels, over the four pixels from `first` on in every block but the last."""
    end = lines.shape[1] - COMPRESSION_BLOCK_PX
    a, b, c, d = (lines[:, first + k : end + first + k : COMPRESSION_BLOCK_PX] for k in range(4))
    return float(np.abs(a - d + 3 * (c - b)).mean())


def has_few_levels(image: NDArray[np.uint8]) -> bool:
    """Return whether the green of an image, (320, 240, 3) uint8 BGR, has steps of more than `LEVEL_STEP_MAX`."""
    return level_step(image[::LINE_STEP_PX, ::LINE_STEP_PX, 1]) > LEVEL_STEP_MAX


def level_step(levels: NDArray[np.uint8]) -> float:
    """Return the mean distance of neighboring gray levels in use; 0 with fewer than two. levels: (n, m) uint8."""
    used = np.flatnonzero(np.bincount(levels.ravel(), minlength=256) >= LEVEL_PIXELS_MIN)
    return 0.0 if len(used) < 2 else float(used[-1] - used[0]) / (len(used) - 1)


def is_noisy(image: NDArray[np.uint8]) -> bool:
    """Return whether the green of an image, (320, 240, 3) uint8 BGR, is mostly noise from pixel to pixel."""
    levels = image[::NOISE_ROW_STEP_PX, :, 1].astype(np.int16)
    bent = np.abs(levels[:, 2:] - 2 * levels[:, 1:-1] + levels[:, :-2]) > NOISE_LEVELS
    return bool(2 * np.count_nonzero(bent) > bent.size)


def _colors_swapped(blocks: Blocks, background: Blocks, weights: NDArray[np.float32]) -> bool:
    """Return whether the channels correlate better with those of the background image in another order.

    weights: (1200,), zero in the contact, whose own colors follow no order; their sum is one.
    """
    here, there = blocks - weights @ blocks, background - weights @ background
    weighted = here * weights[:, np.newaxis]
    deviations = np.sqrt(np.outer(weights @ np.square(there), (weighted * here).sum(axis=0)) + np.float32(1e-3))
    orders = ((there.T @ weighted) / deviations).take(_ORDERS).sum(axis=1)
    return bool(orders[1:].max() > orders[0] + SWAPPED_MARGIN)


def _clipped_share(image: NDArray[np.uint8]) -> Blocks | None:
    """Return the share of each block's pixels at either end of the range, (1200, 3); None if no pixel is."""
    clipped = (image == 0) | (image == 255)
    if not clipped.any():
        return None
    shares = clipped.reshape(BLOCKS_HIGH, 8, BLOCKS_WIDE, 8, 3).mean(axis=(1, 3), dtype=np.float32)
    return np.asarray(shares.reshape(-1, 3), np.float32)


def _unevenness(blocks: Blocks) -> Blocks:
    """Return the second difference of blocks along columns, (1140, 3) float32, gray levels.

    An even slope of the light and columns that flicker do not contribute.
    """
    middle = blocks[BLOCKS_WIDE:-BLOCKS_WIDE]
    return np.asarray(np.abs(blocks[2 * BLOCKS_WIDE :] - middle - middle + blocks[: -2 * BLOCKS_WIDE]), np.float32)
