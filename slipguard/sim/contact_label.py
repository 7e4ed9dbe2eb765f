"""The contact label for training: the visibly pressed region with its gaps closed, as a person would label it.

The exact contact patch is not the right label. People recognize a press by its slopes, include them, and ignore the
gaps between ribs and the flat middle between two edges.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from slipguard.sim.gel_camera import GelTruth

PRESS_SHARE = 0.15
"""The label covers displacements above this share of the deepest press; tuned on the tuning frames."""
HIDDEN_PRESS_SHARE = 0.1
"""Share used if the deepest point is outside the image: the skirt of a press outside is no contact inside."""
VISIBLE_MM = 0.02
"""The slope of a shallower press is hidden by noise."""
GAP_RADIUS_PX = 15
"""Gaps up to twice this width are closed: 0.8 mm on each side at 18.5 px/mm."""
LABEL_NAME = f"displaced>{PRESS_SHARE:g}*press,closed{GAP_RADIUS_PX}px"


def label(truth: GelTruth, share: float = PRESS_SHARE) -> NDArray[np.uint8]:
    """Return the label, (320, 240) uint8, 0 or 1: gel displaced by over `share` of the press depth, gaps closed."""
    visible_mm = float(truth.displacement_mm.max())
    least_mm = max(share * visible_mm, HIDDEN_PRESS_SHARE * truth.press_mm, VISIBLE_MM)
    return closed_region(truth.displacement_mm > least_mm)


def closed_region(pressed: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Return a region with gaps and holes filled, (H, W) uint8, 0 or 1."""
    region = np.asarray(pressed, np.uint8)
    return _filled(_closed(region)) if region.any() else region


def _closed(mask: NDArray[np.uint8]) -> NDArray[np.uint8]:
    size = 2 * GAP_RADIUS_PX + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    pad = 2 * size
    wide = cv2.copyMakeBorder(mask, pad, pad, pad, pad, cv2.BORDER_REPLICATE)
    closed = cv2.morphologyEx(wide, cv2.MORPH_CLOSE, disc)
    return np.ascontiguousarray(closed[pad:-pad, pad:-pad], np.uint8)


def _filled(mask: NDArray[np.uint8]) -> NDArray[np.uint8]:
    contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    filled = np.zeros_like(mask)
    cv2.drawContours(filled, contours, -1, (1.0,), -1)
    return filled
