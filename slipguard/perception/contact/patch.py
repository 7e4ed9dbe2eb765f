"""From the network's probability map to the one patch that is measured: threshold, regions, borders.

Regions of a rigid object turn together, so those of comparable size are measured as one patch; specks are left out.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.perception.contact.contour import ragged_px

MARGIN_PX = 5
"""Empty rim of a patch's crop (network pixels), so that blurs and gradients have room; less at the frame's edge."""
COMPARABLE_SHARE = 0.30
"""A region of at least this share of the largest belongs to the patch, wherever it is."""
NEAR_SHARE = 0.08
NEAR_PX = 6
"""A region this close to the largest (network pixels between the boxes) belongs to it from a smaller share on."""

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
    """The contact that is measured, at network resolution.

    mask: (h, w) uint8, 0 or 1; a crop of the network's picture around the patch.
    probability: (h, w) float32, the network's probability in the crop, 0 away from the patch.
    left_px, top_px: network pixel of the crop's first column and row.
    image_size: (width, height) of the network's picture.
    frame_px: frame pixels per network pixel.
    clipped: the sides of the frame that the patch touches.
    regions: how many separate regions it is made of.
    ragged_px: how far its outline is off, judged by its raggedness, network pixels; 0 for most.
    """

    mask: NDArray[np.uint8]
    probability: NDArray[np.float32]
    left_px: int
    top_px: int
    image_size: tuple[int, int]
    frame_px: float
    clipped: ClippedSides
    regions: int
    ragged_px: float = 0.0

    @property
    def area_px(self) -> int:
        """Area in frame pixels (240 x 320)."""
        return round(int(np.count_nonzero(self.mask)) * self.frame_px**2)

    def to_frame(self, x_px: float, y_px: float) -> tuple[float, float]:
        """Crop coordinates (pixel centres at whole numbers) to frame coordinates, pixels right and down."""
        s = self.frame_px
        return ((x_px + self.left_px + 0.5) * s - 0.5, (y_px + self.top_px + 0.5) * s - 0.5)

    def full_mask(self) -> NDArray[np.uint8]:
        """The mask in the network's picture: (height, width) uint8, 0 or 1."""
        return self._whole(self.mask)

    def full_probability(self) -> NDArray[np.float32]:
        """The probability in the network's picture: (height, width) float32, 0 away from the contact."""
        return self._whole(self.probability)

    def _whole(self, part: NDArray[_Value]) -> NDArray[_Value]:
        width, height = self.image_size
        full = np.zeros((height, width), part.dtype)
        rows, columns = part.shape
        full[self.top_px : self.top_px + rows, self.left_px : self.left_px + columns] = part
        return full


def find_patch(probability: NDArray[np.float32], threshold: float, min_area_px: float, frame_px: float) -> Patch | None:
    """The contact patch in a probability map, or None where there is no contact.

    probability: (H, W) float32 in 0..1, at network resolution; NaN counts as 0, what is beyond 0..1 as its nearest end.
    threshold: contact where the probability is above. min_area_px: smallest region kept, in frame pixels.
    frame_px: frame pixels per network pixel.
    """
    above = (probability > threshold).view(np.uint8)
    count, found = cv2.connectedComponents(above, connectivity=8, ltype=cv2.CV_16U)
    labels = np.asarray(found, np.uint16)
    if count < 2:
        return None
    smallest = min_area_px / frame_px**2
    if count == 2:
        mask, regions = above, 1
        if np.count_nonzero(above) < smallest:
            return None
    else:
        chosen = _chosen(labels, count, smallest)
        if not chosen:
            return None
        keep = np.zeros(count, np.uint8)
        keep[chosen] = 1
        mask, regions = keep[labels], len(chosen)
    return _cut(mask, probability, frame_px, regions)


def _chosen(labels: NDArray[np.uint16], count: int, smallest: float) -> list[int]:
    """Labels of the regions that make the patch, the largest first."""
    areas = np.bincount(labels.ravel(), minlength=count)
    areas[0] = 0
    largest = int(areas.argmax())
    if areas[largest] < smallest:
        return []
    chosen = [largest]
    candidates = [
        label
        for label in range(1, count)
        if label != largest and areas[label] >= max(smallest, NEAR_SHARE * areas[largest])
    ]
    if not candidates:
        return chosen
    x0, y0, w0, h0 = cv2.boundingRect((labels == largest).view(np.uint8))
    for label in candidates:
        if areas[label] >= COMPARABLE_SHARE * areas[largest]:
            chosen.append(label)
            continue
        x1, y1, w1, h1 = cv2.boundingRect((labels == label).view(np.uint8))
        gap = max(x1 - x0 - w0, x0 - x1 - w1, y1 - y0 - h0, y0 - y1 - h1)
        if gap <= NEAR_PX:
            chosen.append(label)
    return chosen


def _cut(mask: NDArray[np.uint8], probability: NDArray[np.float32], frame_px: float, regions: int) -> Patch:
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
        ragged_px=ragged_px(crop),
    )
