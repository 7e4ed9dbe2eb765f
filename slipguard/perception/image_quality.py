"""Whether a frame shows this unit's gel: one pass over its block means, one table of what is unusual.

A frame beyond one limit of the table says nothing: neither a rotation nor whether there is contact. In bad light the
network finds no contact on a pressed gel; and sharp structures that stay in place while the contact rotates (edges of
compression blocks, steps between few gray levels) hold the registration back, for which no sigma can account.

orn frames: the part above a line is of one capture, the part below it of another, and no flag says so.

A tear is one pixel sharp, and the optics are not: an edge of the object spreads over several pixels, however fast it
moves. So a line is compared with its neighbors in the difference between the frame and the last good one, where
everything that stays in place cancels. At a tear the step from line to line equals the difference between what lies
below and what lies above, and the steps before and after it do not. Both parts of a torn frame match their captures
up to the line, so a frame without motion between its captures shows no tear and needs no rejection.

A DIGIT reads out columns of the portrait frame; another camera may read out rows. Both are tested.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.perception.estimate import DeclineReason, explain
from slipguard.perception.skipping import BLACK_LEVEL, BLOCKS_HIGH, BLOCKS_WIDE, WHITE_LEVEL, Blocks, block_means

Image = NDArray[np.uint8]
Lines = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Limit:
    """One row of the table. The image is unusable above `limit`, or below it if `least`.

    what: the figure in words, with its value. advice: what to check.
    """

    limit: float
    what: str
    advice: str
    least: bool = False

    def is_beyond(self, value: float) -> bool:
        """Return whether a figure makes the image unusable; NaN does."""
        return not (value >= self.limit if self.least else value <= self.limit)

    def explain(self, value: float) -> str:
        """Return figure, limit and advice in one line."""
        return f"{self.what.format(value)} ({'minimum' if self.least else 'limit'} {self.limit:g}); {self.advice}"


LIGHT = "check light, lens and cable of the sensor, or calibrate again"
LIMITS = {
    # Mean gray level. Real gels have 90 and more; at 9, on a few levels, the texture rotates back by a fifth.
    "level": Limit(25.0, "mean of {:.0f} gray levels", "check the LEDs, the exposure and the cable", True),
    "white": Limit(0.25, "{:.2f} of the image is white", "check exposure, gain and foreign light"),
    # Root mean square of the colors' differences over the mean level: 0.29 and more on six real gels, 0.11 on 400
    # rendered units.
    "color": Limit(0.05, "colors that differ by {:.2f} of the level", "a gray image: check the stream's format", True),
    # Even change of a color's light: real and rendered drifts reach 10 gray levels. At half of its light, -60 to -40
    # levels, the network misses a quarter of the contacts; below 0.2 it misses all.
    "light": Limit(30.0, "a color's light differs by {:.0f} gray levels from the background image", LIGHT),
    # The rest of the difference, mean: 1-3 gray levels, 5.8 at most in real and rendered frames; a failing lamp 9 and
    # more.
    "pattern": Limit(8.0, "the light's pattern differs by {:.1f} gray levels from the background image", LIGHT),
    # Three correlations with the background image, the best other order of the colors less the right one: 0.1 and more
    # if colors are swapped (99 % of rendered frames), -0.03 at most if not.
    "swapped": Limit(0.08, "colors correlate better in another order, by {:.2f}", "check the stream's format"),
    # Too little of the gel is left to show light and contour.
    "covered": Limit(0.9, "contact over {:.2f} of the image", "grip the object elsewhere, or calibrate again"),
    # A contact with more of its blocks all black or all white lies under a glare or a dead spot that hides its contour.
    "clipped": Limit(0.02, "{:.2f} of the contact is black or white", "check for glare, and exposure and gain"),
    # The gel's own pattern: 0.87 of the background's and more in real frames, 1.0 in rendered ones; 0.3-0.75 under a
    # blur of 9 pixels. An image without it is out of focus, and the light's glow outweighs a faint contact.
    "detail": Limit(0.7, "{:.2f} of the background image's detail", "check focus, lens and gel", True),
    # Curvature across block borders over that inside blocks: 4.3 and more at JPEG quality 23 on 60 rendered units;
    # 0.7-1.5 without compression, real gels included; 3.1 at most at quality 75, 3.7 at 60.
    "compression": Limit(4.0, "blockiness {:.1f}", "use a JPEG quality of at least 75"),
    # Mean step between gray levels in use: 1.0-1.8 in real gels and 60 rendered units, 6 if four times the light clips
    # most of the image; 32, and sometimes 16, hold rotations back.
    "step": Limit(12.0, "steps of {:.0f} gray levels", "check exposure and gain"),
    # Share of second differences along a row above 16 gray levels. Their median is that in white noise of ten gray
    # levels (1.65 times it), and 2 in real frames of nine units. Edges are too few to count.
    "noise": Limit(0.5, "{:.2f} of all pixels are noise", "check light and gain"),
}
"""What is unusual, in the order of explanation. Figures that need the background image are left out without one."""

FOCUS_MIN = 60
"""Fewer blocks than this away from the contact are not enough to compare detail."""
COMPRESSION_BLOCK_PX = 8
"""Blocks of JPEG and motion JPEG; 240 and 320 are whole multiples of them, however the sensor is mounted."""
LINE_STEP_PX = 4
"""Step in rows and columns between the pixels tested for compression and gray levels."""
BLOCKINESS_FLOOR_LEVELS = 0.05
"""Smallest curvature inside blocks, gray levels: an image without any detail is flatter."""
LEVEL_PIXELS_MIN = 5
"""A gray level is in use if this many of the 4,800 tested pixels have it: hot pixels fill no gap."""
NOISE_ROW_STEP_PX = 16
NOISE_LEVELS = 16
_ORDERS = np.array([[3 * k + c for k, c in enumerate(order)] for order in itertools.permutations(range(3))])
"""The six orders of three channels, as indices into a 3 x 3 table; the right one first."""
_EVERYWHERE = np.ones(BLOCKS_HIGH * BLOCKS_WIDE, np.bool_)

GROUP_PX = 8
"""Pixels along a line are averaged over this length: their noise falls, and no structure of the gel is finer."""
SIDE_PX = 4
"""Lines on each side whose mean difference is compared with the step."""
SHARP_MIN, SHARP_MAX = 0.7, 1.5
"""Step at a line over the difference between both sides: 1 at a tear. An edge blurred with a standard deviation of
0.8 pixels reaches 0.3; cameras behind a gel blur more. Thin structures have a step but no difference of the sides."""
OUTSTANDING_MIN = 5.0
"""The step, as a multiple of that of 95 % of the lines and of all nearby ones. Without a tear the largest is 1.5 by
chance, and 2.6 in pairs of real frames that were compressed in blocks."""
NEAR_PX = (2, 8)
"""Distances of the nearby lines: edges blur over less, blocks of compressed video repeat within."""
NOISE_FLOOR_LEVELS = 0.05
"""Assumed noise of a group's step, gray levels, where an image has none."""
REFUSED_MAX_S = 0.15
"""This long after the last good frame the next one counts as good: a sharp line that stays, such as a dead one, is no
tear. It is half of the default `frames_timeout_s`, so refused frames alone never stop the arm."""

_STEP = np.array([[0.5, -1.5, 1.5, -0.5]], np.float32)
"""Step from line k - 1 to line k, minus the mean of the steps before and after it; on lines k - 2 to k + 1."""
_SIDES = np.repeat(np.array([[-1.0, 1.0]], np.float32) / SIDE_PX, SIDE_PX, axis=1)
"""Mean of the lines from k on minus that of the lines before k."""
_MEAN = np.tile(np.eye(3, dtype=np.float32) / np.float32(GROUP_PX), (GROUP_PX, 1))
"""(24, 3): the mean of 8 pixels along a row, each with three colors."""


class ImageQuality:
    """Checks the frames of one unit. Stateless.

    Args:
        background: (320, 240, 3) uint8 BGR, or None: then light, color order and focus are not checked.
    """

    def __init__(self, background: Image | None) -> None:
        self._background = None if background is None else block_means(background)
        self._clipped = None if background is None else _clipped_share(background)
        self._colored = False
        if self._background is not None:
            mean = self._background.mean(axis=0)
            self._centered = self._background - mean
            self._squares = np.square(self._centered)
            self._fine = _unevenness(self._background)
            covariance = self._centered.T @ self._centered / np.float32(len(self._centered))
            self._colored = not LIMITS["color"].is_beyond(_color(mean, covariance))

    def check(self, image: Image, blocks: Blocks, near: NDArray[np.bool_] | None) -> str | None:
        """Return why a frame does not show this unit's gel, as in `Estimate.declined`; None if it does.

        Args:
            image: (320, 240, 3) uint8 BGR.
            blocks: (1200, 3) float32, its block means.
            near: (1200,) bool, the blocks in and around the contact. None: the blocks show none, only noise and a
                drift of the light, so only level and color of the light are checked.
        """
        figures = self._block_figures(blocks, near)
        for what, value in itertools.chain(figures, () if near is None else pixel_figures(image)):
            if LIMITS[what].is_beyond(value):
                return explain(DeclineReason.IMAGE, LIMITS[what].explain(value))
        return None

    def _block_figures(self, blocks: Blocks, near: NDArray[np.bool_] | None) -> Iterator[tuple[str, float]]:
        covered = 0.0 if near is None else float(np.count_nonzero(near)) / len(near)
        away = _EVERYWHERE if near is None or covered > LIMITS["covered"].limit else ~near
        outside = away.astype(np.float32)
        count = float(outside.sum())
        weights = outside / count
        yield "level", float(blocks.mean())
        yield "white", float(np.count_nonzero(blocks > WHITE_LEVEL)) / blocks.size
        background = self._background
        if background is not None:
            mean = weights @ blocks
            here = blocks - mean
            weighted = here * weights[:, np.newaxis]
            covariance = here.T @ weighted
            if self._colored:
                yield "color", _color(mean, covariance)
            difference = blocks - background
            light = weights @ difference
            yield "light", float(np.abs(light).max())
            if near is None:
                return
            yield "pattern", float((weights @ np.abs(difference - light)).sum()) / 3.0
            known_variance = weights @ self._squares - np.square(weights @ self._centered)
            yield "swapped", _swapped(self._centered.T @ weighted, np.diag(covariance), known_variance)
        yield "covered", covered
        if near is not None and covered > 0.0:
            yield "clipped", self._clipped_contact(blocks, near)
        if background is not None:
            detail = _detail(blocks, background, self._fine, away)
            if detail is not None:
                yield "detail", detail

    def _clipped_contact(self, blocks: Blocks, near: NDArray[np.bool_]) -> float:
        """Return the share of the contact that is black or white in all colors, or always in one.

        If pixels of the background image are at the end of a color's range, a contact shows edges that stay while it
        rotates; nine real units have none.
        """
        share = 0.0
        if blocks.max() > WHITE_LEVEL or blocks.min() < BLACK_LEVEL:
            contact = blocks[near]
            share = float(((contact > WHITE_LEVEL).all(axis=1) | (contact < BLACK_LEVEL).all(axis=1)).mean())
        return share if self._clipped is None else max(share, float(self._clipped[near].mean(axis=0).max()))


def check_background(image: Image) -> str | None:
    """Return why an image, (320, 240, 3) uint8 BGR, cannot be a background image; None if it can."""
    blocks = block_means(image)
    centered = blocks - blocks.mean(axis=0)
    color = _color(blocks.mean(axis=0), centered.T @ centered / np.float32(len(blocks)))
    if LIMITS["color"].is_beyond(color) and blocks.mean() >= LIMITS["level"].limit:
        return explain(DeclineReason.IMAGE, LIMITS["color"].explain(color))
    return ImageQuality(None).check(image, blocks, ~_EVERYWHERE)


def _color(mean: NDArray[Any], covariance: NDArray[Any]) -> float:
    """Return the root mean square of the colors' differences over that of the level. mean: (3,). covariance: (3, 3)."""
    level_square = (float(mean.sum()) ** 2 + float(covariance.sum())) / 9.0
    square = float(mean @ mean) + float(np.trace(covariance)) - 3.0 * level_square
    return math.sqrt(max(square, 0.0) / max(level_square, 1.0))


def _swapped(
    products: NDArray[np.float32], variances: NDArray[np.float32], known_variances: NDArray[np.float32]
) -> float:
    """Return how much better the channels correlate with those of the background image in another order.

    products: (3, 3), covariances of the background image's channels (rows) with those of the frame, away from the
    contact, whose own colors follow no order. variances, known_variances: (3,) of frame and background image.
    """
    deviations = np.sqrt(np.outer(known_variances, variances).clip(0.0) + np.float32(1e-3))
    orders = (products / deviations).take(_ORDERS).sum(axis=1)
    return float(orders[1:].max() - orders[0])


def _detail(blocks: Blocks, background: Blocks, fine: Blocks, away: NDArray[np.bool_]) -> float | None:
    """Return the unevenness over the background image's, less light allowed for; None if too little can be compared."""
    outside = (away[: -2 * BLOCKS_WIDE] & away[BLOCKS_WIDE:-BLOCKS_WIDE] & away[2 * BLOCKS_WIDE :]).astype(np.float32)
    before = float((outside @ fine).sum())
    if float(outside.sum()) < FOCUS_MIN or before <= 0.0:
        return None
    middle = slice(BLOCKS_WIDE, -BLOCKS_WIDE)
    light = float((outside @ blocks[middle]).sum()) / max(float((outside @ background[middle]).sum()), 1.0)
    return float((outside @ _unevenness(blocks)).sum()) / (min(light, 1.0) * before)


def pixel_figures(image: Image) -> Iterator[tuple[str, float]]:
    """Yield what block means do not show, from a part of the green pixels."""
    green = image[..., 1]
    along = blockiness(green[::LINE_STEP_PX].astype(np.int16))
    if along > LIMITS["compression"].limit:  # rows and columns both break at block borders
        along = min(along, blockiness(green[:, ::LINE_STEP_PX].T.astype(np.int16)))
    yield "compression", along
    yield "step", level_step(green[::LINE_STEP_PX, ::LINE_STEP_PX])
    levels = green[::NOISE_ROW_STEP_PX].astype(np.int16)
    bent = np.abs(levels[:, 2:] - 2 * levels[:, 1:-1] + levels[:, :-2]) > NOISE_LEVELS
    yield "noise", float(np.count_nonzero(bent)) / bent.size


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


def level_step(levels: Image) -> float:
    """Return the mean distance of neighboring gray levels in use; 0 with fewer than two. levels: (n, m) uint8."""
    used = np.flatnonzero(np.bincount(levels.ravel(), minlength=256) >= LEVEL_PIXELS_MIN)
    return 0.0 if len(used) < 2 else float(used[-1] - used[0]) / (len(used) - 1)


def _clipped_share(image: Image) -> Blocks | None:
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


def find_tear(image: Image, previous: Image) -> str | None:
    """Return before which line a frame is torn, as "column 120"; None if its captures do not differ there.

    A tear in the previous frame is not attributed to this one.

    Args:
        image: (h, w, 3) uint8; h and w are multiples of 8.
        previous: The same shape.
    """
    change = np.asarray(cv2.subtract(image, previous, dtype=cv2.CV_32F), np.float32)
    line = _torn_line(image, previous, _grouped(change))
    if line is not None:
        return f"column {line}"
    rows, columns = image.shape[0], image.shape[1] // GROUP_PX
    along_rows = change.reshape(rows * columns, 3 * GROUP_PX) @ _MEAN
    grouped = np.ascontiguousarray(along_rows.reshape(rows, columns, 3).transpose(1, 0, 2))
    line = _torn_line(image.transpose(1, 0, 2), previous.transpose(1, 0, 2), grouped)
    return None if line is None else f"row {line}"


def _grouped(levels: Lines) -> Lines:
    """Return means over 8 pixels of the first axis: (n, m, 3) to (n / 8, m, 3) float32."""
    count, length = levels.shape[0] // GROUP_PX, levels.shape[1]
    means = levels.reshape(count, GROUP_PX, 3 * length).sum(axis=1) * np.float32(1.0 / GROUP_PX)
    return np.asarray(means.reshape(count, length, 3), np.float32)


def _torn_line(image: Image, previous: Image, difference: Lines) -> int | None:
    """Return the first line of the lower part; lines are the second axis. difference: `_grouped`, from previous."""
    step = np.asarray(cv2.filter2D(difference, -1, _STEP, anchor=(2, 0)), np.float32)
    sides = np.asarray(cv2.filter2D(difference, -1, _SIDES, anchor=(SIDE_PX, 0)), np.float32)
    inner = slice(SIDE_PX, difference.shape[1] - SIDE_PX + 1)
    joint, square = _products(step, sides)[inner], _products(sides, sides)[inner]
    noise = max(_share(_products(step, step)[inner], 0.5), NOISE_FLOOR_LEVELS**2 * step.shape[0] * 3)
    joint -= _share(joint, 0.5)
    outstanding = joint / np.sqrt(noise * np.maximum(square, 1e-3))
    sizes = np.abs(outstanding)
    typical = _share(sizes, 0.95)
    sharp = (joint > SHARP_MIN * square) & (joint < SHARP_MAX * square)
    found = np.flatnonzero(sharp & (outstanding > OUTSTANDING_MIN * typical)).tolist()
    for at in sorted(found, key=lambda place: -float(outstanding[place])):
        nearest, farthest = NEAR_PX
        before_it, after_it = sizes[max(at - farthest, 0) : max(at - nearest + 1, 0)], sizes[at + nearest :][:farthest]
        nearby = float(np.concatenate([before_it, after_it]).max(initial=0.0))
        if outstanding[at] > OUTSTANDING_MIN * nearby and _is_in(image, previous, at + SIDE_PX, sides):
            return at + SIDE_PX
    return None


def _products(one: Lines, other: Lines) -> NDArray[np.float32]:
    """Return sums of products along each line, of deviations from the line's mean: whole lines flicker in a DIGIT."""
    groups, count, _ = one.shape
    one, other = one.reshape(groups, -1), other.reshape(groups, -1)
    over_line = np.ones(groups, np.float32)
    sums = np.einsum("gk,gk->k", one, other) - (over_line @ one) * (over_line @ other) / np.float32(groups)
    return np.asarray(sums.reshape(count, 3) @ np.ones(3, np.float32), np.float32)


def _share(values: NDArray[np.float32], share: float) -> float:
    """Return the value that this share of the values lies below."""
    place = int(share * len(values))
    return float(np.partition(values, place)[place])


def _is_in(image: Image, previous: Image, line: int, sides: Lines) -> bool:
    """Return whether the step at a line is rather in the image than, with the opposite sign, in the previous one."""
    lines = slice(line - 2, line + 2)
    both = _grouped(np.add(image[:, lines], previous[:, lines], dtype=np.float32))
    step = np.einsum("gkc,k->gc", both, _STEP[0])
    return bool(_products(step[:, None], np.ascontiguousarray(sides[:, line : line + 1]))[0] > 0.0)
