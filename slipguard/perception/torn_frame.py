"""Torn frames: the part above a line is of one capture, the part below it of another, and no flag says so.

A tear is one pixel sharp, and the optics are not: an edge of the object spreads over several pixels, however fast it
moves. So a line is compared with its neighbors in the difference between the frame and the last good one, where
everything that stays in place cancels. At a tear the step from line to line equals the difference between what lies
below and what lies above, and the steps before and after it do not. Both parts of a torn frame match their captures
up to the line, so a frame without motion between its captures shows no tear and needs no rejection.

A DIGIT reads out columns of the portrait frame; another camera may read out rows. Both are tested.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

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

Image = NDArray[np.uint8]
Lines = NDArray[np.float32]


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
