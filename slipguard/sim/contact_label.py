"""What a person would outline: the visibly pressed region, its gaps closed.

The exact contact patch is the wrong thing to learn. People see a press by its slopes and outline them, skirt included,
and pass over the gaps between ribs and the flat middle between two edges.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from slipguard.sim.gel_camera import GelTruth

PRESS_SHARE = 0.15
"""Pressed is what moved by more than this share of the deepest press; chosen on the tuning frames."""
HIDDEN_PRESS_SHARE = 0.1
"""Where the deepest point lies outside the picture: the skirt of what is out there is no contact in here."""
VISIBLE_MM = 0.02
"""A press shallower than this leaves no slope that can be told from noise."""
GAP_RADIUS_PX = 15
"""Gaps up to twice this wide are closed: 0.8 mm either side at 18.5 px/mm."""
LABEL_NAME = f"displaced>{PRESS_SHARE:g}*press,closed{GAP_RADIUS_PX}px"


def label(truth: GelTruth, share: float = PRESS_SHARE) -> NDArray[np.uint8]:
    """The region to learn, (320, 240) uint8, 0 or 1: gel moved by over `share` of the press depth, gaps closed."""
    seen_mm = float(truth.displacement_mm.max())
    least_mm = max(share * seen_mm, HIDDEN_PRESS_SHARE * truth.press_mm, VISIBLE_MM)
    return outlined(truth.displacement_mm > least_mm)


def outlined(pressed: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """A region without its gaps and holes, (H, W) uint8, 0 or 1."""
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
    outlines, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    filled = np.zeros_like(mask)
    cv2.drawContours(filled, outlines, -1, (1.0,), -1)
    return filled
