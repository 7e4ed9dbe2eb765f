"""The contact patch: from the network's probability map to the one mask that is measured.

Regions of a rigid object rotate together, so regions of comparable size form one patch; small ones are ignored.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.devices import FRAME_HEIGHT_PX, FRAME_WIDTH_PX

MARGIN_PX = 5
"""Empty rim of a patch's crop (network pixels), so that blurs and gradients have room; less at the frame's edge."""
COMPARABLE_SHARE = 0.30
"""A region of at least this share of the largest belongs to the patch, wherever it is."""
NEAR_SHARE = 0.08
NEAR_PX = 6
"""A region this close to the largest (network pixels between the boxes) belongs to it if it has at least this share."""
MEAN_MIN = 0.78
"""Smallest mean probability of a region. Light and wear of an untouched gel give at most 0.78 (real units, a background
image of another day or none); presses of objects reach 0.78 (real, no background image) and 0.92 (with one)."""

CONTOUR_REACH = 5
"""Contour pixels on either side of one: smooth errors of the network are correlated over this length."""
SMOOTH_PX = 1.2
"""Contours of objects bulge by 0.4-1.2 pixels over this reach, corners included (99 % of the rendered ones)."""
RAGGED_GAIN = 4.0
"""Contour error in pixels per pixel of additional bulge: 1.5 where it is off by 2, 2.6 where by 3."""
PIECES_MAX = 40
"""A mask with more contours than this is ragged all over."""

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


@dataclass(frozen=True, slots=True, eq=False)
class Patch:
    """The measured contact, at network resolution.

    mask: (h, w) uint8, 0 or 1; a crop of the network's image around the patch.
    probability: (h, w) float32, the network's probability in the crop, 0 away from the patch.
    left_px, top_px: network pixel of the crop's first column and row.
    image_size: (width, height) of the network's image.
    frame_px: frame pixels per network pixel.
    clipped: the sides of the frame that the patch touches.
    regions: number of separate regions in it.
    """

    mask: NDArray[np.uint8]
    probability: NDArray[np.float32]
    left_px: int
    top_px: int
    image_size: tuple[int, int]
    frame_px: float
    clipped: ClippedSides
    regions: int

    @property
    def area_px(self) -> int:
        """Area in frame pixels (240 x 320)."""
        return round(cv2.countNonZero(self.mask) * self.frame_px**2)

    @property
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
    above = (probability > threshold).view(np.uint8)
    count, found = cv2.connectedComponents(above, connectivity=8, ltype=cv2.CV_16U)
    labels = np.asarray(found, np.uint16)
    if count < 2:
        return None
    smallest = min_area_px / frame_px**2
    if count == 2:
        mask, regions = above, 1
        area = np.count_nonzero(above)
        if area < smallest or _sum(probability[above > 0]) < MEAN_MIN * area:
            return None
    else:
        selected = _select_regions(labels, probability, count, smallest)
        if not selected:
            return None
        keep = np.zeros(count, np.uint8)
        keep[selected] = 1
        mask, regions = keep[labels], len(selected)
    return _crop(mask, probability, frame_px, regions)


def _select_regions(
    labels: NDArray[np.uint16], probability: NDArray[np.float32], count: int, smallest: float
) -> list[int]:
    """Return the labels of the regions that form the patch, the largest first."""
    areas = np.bincount(labels.ravel(), minlength=count)
    areas[0] = 0
    valid = np.minimum(np.where(np.isnan(probability), np.float32(0.0), probability), np.float32(1.0))
    sums = np.bincount(labels.ravel(), valid.ravel(), minlength=count)
    areas[(areas >= max(smallest, 1.0)) & (sums < MEAN_MIN * areas)] = 0
    largest = int(areas.argmax())
    if areas[largest] < smallest:
        return []
    selected = [largest]
    candidates = [
        label
        for label in range(1, count)
        if label != largest and areas[label] >= max(smallest, NEAR_SHARE * areas[largest])
    ]
    if not candidates:
        return selected
    x0, y0, w0, h0 = cv2.boundingRect((labels == largest).view(np.uint8))
    for label in candidates:
        if areas[label] >= COMPARABLE_SHARE * areas[largest]:
            selected.append(label)
            continue
        x1, y1, w1, h1 = cv2.boundingRect((labels == label).view(np.uint8))
        gap = max(x1 - x0 - w0, x0 - x1 - w1, y1 - y0 - h0, y0 - y1 - h1)
        if gap <= NEAR_PX:
            selected.append(label)
    return selected


def _sum(probability: NDArray[np.float32]) -> float:
    return float(np.minimum(probability, np.float32(1.0)).sum())


def _crop(mask: NDArray[np.uint8], probability: NDArray[np.float32], frame_px: float, regions: int) -> Patch:
    height, width = mask.shape
    x, y, w, h = cv2.boundingRect(mask)
    left, top = max(x - MARGIN_PX, 0), max(y - MARGIN_PX, 0)
    right, bottom = min(x + w + MARGIN_PX, width), min(y + h + MARGIN_PX, height)
    crop = np.ascontiguousarray(mask[top:bottom, left:right])
    near = cv2.dilate(crop, _NEAR)
    soft = np.where(near > 0, probability[top:bottom, left:right], np.float32(0.0))
    np.fmax(soft, np.float32(0.0), out=soft)  # also NaN
    np.minimum(soft, np.float32(1.0), out=soft)
    crop.flags.writeable = False
    soft.flags.writeable = False
    return Patch(
        mask=crop,
        probability=soft,
        left_px=left,
        top_px=top,
        image_size=(width, height),
        frame_px=frame_px,
        clipped=ClippedSides(x == 0, y == 0, x + w == width, y + h == height),
        regions=regions,
    )


def ragged_px(mask: NDArray[np.uint8]) -> float:
    """Return the contour error of a mask in pixels, estimated from its raggedness; 0 for the contours of objects.

    The bulge of a contour at a pixel is its distance to the midpoint of the pixels `CONTOUR_REACH` before and after it.

    Args:
        mask: (H, W) uint8, 0 or 1.
    """
    contours, _ = cv2.findContours(mask, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    if len(contours) > PIECES_MAX:
        return RAGGED_GAIN * (CONTOUR_REACH / 2.0 - SMOOTH_PX)
    bulge, count = 0.0, 0
    for contour in contours:
        count += len(contour)
        if len(contour) < 4 * CONTOUR_REACH:
            bulge += len(contour) * CONTOUR_REACH / 2.0
            continue
        points = contour[:, 0].astype(np.float32)
        around = np.concatenate([points[-CONTOUR_REACH:], points, points[:CONTOUR_REACH]])
        away = points - 0.5 * (around[: -2 * CONTOUR_REACH] + around[2 * CONTOUR_REACH :])
        bulge += float(np.sqrt(np.einsum("ij,ij->i", away, away)).sum())
    return RAGGED_GAIN * max(bulge / max(count, 1) - SMOOTH_PX, 0.0)


def resize_mask_to_frame(mask: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return a mask of the network's resolution as (320, 240) uint8."""
    size = (FRAME_WIDTH_PX, FRAME_HEIGHT_PX)
    return np.asarray(cv2.resize(mask, size, interpolation=cv2.INTER_NEAREST), np.uint8)
