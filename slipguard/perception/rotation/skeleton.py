"""The axis of a patch from its thinned line, corner branches left out."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.perception.contact.patch import Patch
from slipguard.perception.rotation.thinning import thin

CORNER_SLOPE = 0.5
"""Along a line of the skeleton the distance to the outline changes by the sine of half the angle between the two sides
it halves: 0.7 towards a right corner, near 0 along a bar. Steeper than this is a branch into a corner."""
BEYOND_PX = 12
"""How far a patch cut by the frame is continued beyond it, network pixels: its line must not fork at the cut."""


@dataclass(frozen=True, slots=True, eq=False)
class MiddleLine:
    """The pixels of the thinned patch that tell its axis.

    x_px, y_px: crop coordinates, right and down. weight: distance to the outline, network pixels.
    share: how much of the thinned patch these are. skeleton: (h, w) uint8, the whole thinned patch, in the crop.
    """

    x_px: NDArray[np.float64]
    y_px: NDArray[np.float64]
    weight: NDArray[np.float64]
    share: float
    skeleton: NDArray[np.uint8]


def middle_line(patch: Patch) -> MiddleLine:
    """Thin the patch and keep what is no corner branch and not within a half width of a side cut by the frame."""
    sides = patch.clipped
    top, bottom = BEYOND_PX * sides.top, BEYOND_PX * sides.bottom
    left, right = BEYOND_PX * sides.left, BEYOND_PX * sides.right
    mask = patch.mask
    if sides.any:
        mask = np.asarray(cv2.copyMakeBorder(mask, top, bottom, left, right, cv2.BORDER_REPLICATE), np.uint8)
    inside = cv2.distanceTransform(mask, cv2.DIST_L2, 5)
    skeleton = thin(mask)
    rows, columns = patch.mask.shape
    skeleton = skeleton[top : top + rows, left : left + columns]
    y, x = np.nonzero(skeleton)
    slope_x = cv2.Sobel(inside, cv2.CV_32F, 1, 0, ksize=5, scale=1 / 128)[y + top, x + left]
    slope_y = cv2.Sobel(inside, cv2.CV_32F, 0, 1, ksize=5, scale=1 / 128)[y + top, x + left]
    weight = inside[y + top, x + left]
    keep = slope_x**2 + slope_y**2 < CORNER_SLOPE**2
    if sides.left:
        keep &= x > weight
    if sides.top:
        keep &= y > weight
    if sides.right:
        keep &= columns - 1 - x > weight
    if sides.bottom:
        keep &= rows - 1 - y > weight
    return MiddleLine(
        x[keep].astype(np.float64),
        y[keep].astype(np.float64),
        weight[keep].astype(np.float64),
        float(np.count_nonzero(keep)) / max(keep.size, 1),
        skeleton,
    )
