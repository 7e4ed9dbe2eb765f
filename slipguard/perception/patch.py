"""The contact patch: from the network's probability map to the one mask that is measured.

Regions of a rigid object rotate together, so all but the small ones form one patch.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.devices import FRAME_HEIGHT_PX, FRAME_WIDTH_PX

MARGIN_PX = 5
"""Empty rim of a patch's crop (network pixels), so that blurs and gradients have room; less at the frame's edge."""
REGION_SHARE = 0.15
"""A region of at least this share of the largest belongs to the patch."""
MEAN_MIN = 0.78
"""Smallest mean probability of a region. Light and wear of an untouched gel give at most 0.78 (real units, a background
image of another day or none); presses of objects reach 0.78 (real, no background image) and 0.92 (with one)."""

_Value = TypeVar("_Value", np.uint8, np.float32)
_NEAR = np.ones((2 * MARGIN_PX - 1, 2 * MARGIN_PX - 1), np.uint8)


@dataclass(frozen=True, slots=True)
class ClippedSides:
    """Which sides of the frame cut the patch."""

    left: bool = False
    top: bool = False
    right: bool = False
    bottom: bool = False

    @property
    def any(self) -> bool:
        return self.left or self.top or self.right or self.bottom


@dataclass(frozen=True, eq=False)
class Patch:
    """The measured contact, at network resolution.

    mask: (h, w) uint8, 0 or 1; a crop of the network's image around the patch.
    probability: (h, w) float32, the network's probability in the crop, 0 away from the patch.
    left_px, top_px: network pixel of the crop's first column and row.
    image_size: (width, height) of the network's image.
    frame_px: frame pixels per network pixel.
    clipped: the sides of the frame that the patch touches.
    """

    mask: NDArray[np.uint8]
    probability: NDArray[np.float32]
    left_px: int
    top_px: int
    image_size: tuple[int, int]
    frame_px: float
    clipped: ClippedSides

    @cached_property
    def area_px(self) -> int:
        """Area in frame pixels (240 x 320)."""
        return round(cv2.countNonZero(self.mask) * self.frame_px**2)

    @cached_property
    def center_px(self) -> tuple[float, float]:
        """Center of the mask in frame pixels, right and down."""
        m = cv2.moments(self.mask, True)
        return self.to_frame(m["m10"] / m["m00"], m["m01"] / m["m00"])

    def to_frame(self, x_px: float, y_px: float) -> tuple[float, float]:
        """Convert crop coordinates (pixel centers at whole numbers) to frame coordinates, pixels right and down."""
        s = self.frame_px
        return ((x_px + self.left_px + 0.5) * s - 0.5, (y_px + self.top_px + 0.5) * s - 0.5)

    def full_mask(self) -> NDArray[np.uint8]:
        """Return the mask in the network's image: (height, width) uint8, 0 or 1."""
        return self._in_full_image(self.mask)

    def full_probability(self) -> NDArray[np.float32]:
        """Return the probability in the network's image: (height, width) float32, 0 away from the contact."""
        return self._in_full_image(self.probability)

    def _in_full_image(self, part: NDArray[_Value]) -> NDArray[_Value]:
        width, height = self.image_size
        full = np.zeros((height, width), part.dtype)
        rows, columns = part.shape
        full[self.top_px : self.top_px + rows, self.left_px : self.left_px + columns] = part
        return full


def find_patch(probability: NDArray[np.float32], threshold: float, min_area_px: float, frame_px: float) -> Patch | None:
    """Return the contact patch of a probability map, or None without contact.

    A region in which the network is unsure all over is the gel's own light or wear, not a contact.

    Args:
        probability: (H, W) float32 in 0..1, at network resolution. NaN counts as 0; other values are clipped.
        threshold: A pixel is contact if its probability is above.
        min_area_px: Smallest region kept, in frame pixels.
        frame_px: Frame pixels per network pixel.
    """
    valid = np.fmin(np.fmax(probability, np.float32(0.0)), np.float32(1.0))
    above = (valid > threshold).view(np.uint8)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(above, connectivity=8, ltype=cv2.CV_16U)
    areas = stats[:, cv2.CC_STAT_AREA]
    areas[0] = 0
    areas[np.bincount(labels.ravel(), valid.ravel(), minlength=count) < MEAN_MIN * areas] = 0
    largest = int(areas.max())
    if largest < max(min_area_px / frame_px**2, 1.0):
        return None
    kept = areas >= max(min_area_px / frame_px**2, REGION_SHARE * largest)
    mask = kept.astype(np.uint8)[labels]
    height, width = mask.shape
    x, y, w, h = cv2.boundingRect(mask)
    left, top = max(x - MARGIN_PX, 0), max(y - MARGIN_PX, 0)
    window = np.s_[top : min(y + h + MARGIN_PX, height), left : min(x + w + MARGIN_PX, width)]
    crop = np.ascontiguousarray(mask[window])
    soft = np.where(cv2.dilate(crop, _NEAR) > 0, valid[window], np.float32(0.0))
    crop.flags.writeable = soft.flags.writeable = False
    clipped = ClippedSides(x == 0, y == 0, x + w == width, y + h == height)
    return Patch(crop, soft, left, top, (width, height), frame_px, clipped)


def resize_mask_to_frame(mask: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return a mask of the network's resolution as (320, 240) uint8."""
    size = (FRAME_WIDTH_PX, FRAME_HEIGHT_PX)
    return np.asarray(cv2.resize(mask, size, interpolation=cv2.INTER_NEAREST), np.uint8)
