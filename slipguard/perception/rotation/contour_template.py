"""The contour template: the reference's blurred contour, how motions change it, and which motions it cannot show."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.perception.contact.patch import Patch

BLUR_PX = 2.0
"""Blur of both images, network pixels: registration converges from within about twice this of the contour."""
EDGE_SHARE = 0.04
"""Pixels whose gradient is above this share of the steepest belong to the contour."""
RIM_PX = 5
"""The contour this close to the edge of the frame is ignored: the network has half of the evidence there."""
CONTRAST_DEG = 12.0
PERIODIC_DEG = 36.0
PERIODIC_SHARE = 0.87
"""A contour is periodic if, within this rotation, its difference from itself falls below this share of the highest."""
RAIL_PX = 6.0
RAIL_CONTRAST = 0.10
"""A shift along the axis by RAIL_PX cannot be measured if it changes the image by less than this (r.m.s.)."""


@dataclass(frozen=True, slots=True, eq=False)
class ContourTemplate:
    """The reference's contour: pixels around its center, their values, and their change by each motion.

    x_px, y_px: (N,) float32 from the center, network pixels, y down. value: (N,) float32.
    motion: (N, 6) float32, change of value by rotation, shift x, shift y, growth, stretch along, stretch across.
    growth_x, growth_y: (N, 3) float32, how far growth and the two stretches move each pixel.
    center_px: in the network's image. slope: (N,) gradient magnitude. contrast: r.m.s. difference of the image from
    itself rotated by `CONTRAST_DEG`.
    periodic: whether the contour repeats itself after a small rotation. rail: the direction (x, y) in which a shift is
    invisible, as along a bar that the frame cuts twice; None if every shift is visible.
    """

    x_px: NDArray[np.float32]
    y_px: NDArray[np.float32]
    value: NDArray[np.float32]
    motion: NDArray[np.float32]
    growth_x: NDArray[np.float32]
    growth_y: NDArray[np.float32]
    slope: NDArray[np.float32]
    center_px: tuple[float, float]
    contrast: float
    periodic: bool
    rail: tuple[float, float] | None


def blurred(patch: Patch) -> NDArray[np.float32]:
    """Return the probability of a patch, blurred: (h, w) float32."""
    return np.asarray(cv2.GaussianBlur(patch.probability, (0, 0), BLUR_PX, borderType=cv2.BORDER_REPLICATE), np.float32)


def make_contour_template(patch: Patch) -> ContourTemplate:
    """Make a template of the reference's patch; it stretches along and across the long axis of its second moments."""
    soft = blurred(patch)
    gx = cv2.Sobel(soft, cv2.CV_32F, 1, 0, scale=0.125, borderType=cv2.BORDER_REPLICATE)
    gy = cv2.Sobel(soft, cv2.CV_32F, 0, 1, scale=0.125, borderType=cv2.BORDER_REPLICATE)
    steep = np.asarray(cv2.magnitude(gx, gy), np.float32)
    contour = steep > EDGE_SHARE * float(steep.max())
    rows, columns = soft.shape
    # If the frame cuts the patch, that part of the contour is not the object's.
    if patch.clipped.left:
        contour[:, :RIM_PX] = False
    if patch.clipped.right:
        contour[:, columns - RIM_PX :] = False
    if patch.clipped.top:
        contour[:RIM_PX] = False
    if patch.clipped.bottom:
        contour[rows - RIM_PX :] = False
    # The blurred images have no detail below two pixels: every second row and column is enough.
    y, x = np.nonzero(contour[::2, ::2])
    y, x = 2 * y, 2 * x
    m = cv2.moments(patch.mask, True)
    center_x, center_y = m["m10"] / m["m00"], m["m01"] / m["m00"]
    slope_x, slope_y = gx[y, x], gy[y, x]
    value, slope = soft[y, x], steep[y, x]
    dx, dy = (x - center_x).astype(np.float32), (y - center_y).astype(np.float32)
    rotated = math.atan2(2.0 * m["mu11"], m["mu20"] - m["mu02"]) / 2.0
    c, s = np.float32(math.cos(rotated)), np.float32(math.sin(rotated))
    along, across = dx * c + dy * s, dy * c - dx * s
    along_slope, across_slope = slope_x * c + slope_y * s, slope_y * c - slope_x * s
    contrast, periodic = _contrast(soft, dx, dy, value, (center_x, center_y))
    ahead_x, ahead_y = dx + np.float32(center_x + RAIL_PX * c), dy + np.float32(center_y + RAIL_PX * s)
    on_rail = _rms(sampled(soft, ahead_x, ahead_y, cv2.BORDER_REPLICATE) - value) < RAIL_CONTRAST
    motion = np.stack(
        # A counter-clockwise rotation moves (dx, dy), y down, by (dy, -dx) per radian.
        [slope_x * dy - slope_y * dx, slope_x, slope_y, slope, -along * along_slope, -across * across_slope],
    ).T
    growth_x = np.stack([-slope_x / slope, along * c, -across * s], axis=1)
    growth_y = np.stack([-slope_y / slope, along * s, across * c], axis=1)
    return ContourTemplate(
        dx,
        dy,
        value,
        motion,
        growth_x,
        growth_y,
        slope,
        (center_x + patch.left_px, center_y + patch.top_px),
        contrast,
        periodic,
        (float(c), float(s)) if on_rail else None,
    )


def _contrast(
    soft: NDArray[np.float32],
    dx: NDArray[np.float32],
    dy: NDArray[np.float32],
    value: NDArray[np.float32],
    center: tuple[float, float],
) -> tuple[float, bool]:
    """Return the r.m.s. difference of the image from itself rotated by `CONTRAST_DEG`, and whether it is periodic.

    A contour that repeats within `PERIODIC_DEG`, like a gear's, cannot distinguish a rotation from the next tooth.
    """
    differences = []
    for rotation_deg in np.arange(CONTRAST_DEG / 2.0, PERIODIC_DEG + 0.1, CONTRAST_DEG / 4.0):
        rotation = math.radians(float(rotation_deg))
        c, s = np.float32(math.cos(rotation)), np.float32(math.sin(rotation))
        x, y = dx * c + dy * s + np.float32(center[0]), dy * c - dx * s + np.float32(center[1])
        differences.append(_rms(sampled(soft, x, y, cv2.BORDER_REPLICATE) - value))
    highest = 0.0
    for difference in differences:
        highest = max(highest, difference)
        if difference < PERIODIC_SHARE * highest:
            return differences[2], True
    return differences[2], False


def sampled(
    image: NDArray[np.float32], x: NDArray[np.float32], y: NDArray[np.float32], border: int
) -> NDArray[np.float32]:
    """Return bilinear values of an image at (N,) points; outside it 0 or its edge value."""
    if x.size == 0:
        return x
    # As one row: OpenCV takes six times as long for a column.
    row = cv2.remap(image, x.reshape(1, -1), y.reshape(1, -1), cv2.INTER_LINEAR, borderMode=border, borderValue=0.0)
    return np.asarray(row, np.float32).ravel()


def _rms(values: NDArray[np.float32]) -> float:
    return math.sqrt(float(values @ values) / max(values.size, 1))
