"""How ragged the outline of a mask is: what an unsteady network adds to a contact's own corners."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

REACH = 5
"""Outline pixels on either side of one: as far as smooth errors of the network are alike."""
SMOOTH_PX = 1.2
"""Contacts of objects bulge by 0.4-1.2 pixels over this reach, their corners included (99 % of the rendered ones)."""
GAIN = 4.0
"""Pixels by which the outline is off for each pixel that it bulges more: 1.5 where it is off by 2, 2.6 where by 3."""
PIECES_MAX = 40
"""A mask with more outlines than this is ragged all over."""


def ragged_px(mask: NDArray[np.uint8]) -> float:
    """About how far the outline is off, in pixels; 0 where it is as smooth as those of objects are.

    mask: (H, W) uint8, 0 or 1. The bulge of an outline at a pixel is its distance to the middle between the pixels
    `REACH` before and after it.
    """
    contours, _ = cv2.findContours(mask, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    if len(contours) > PIECES_MAX:
        return GAIN * (REACH / 2.0 - SMOOTH_PX)
    bulge, count = 0.0, 0
    for contour in contours:
        count += len(contour)
        if len(contour) < 4 * REACH:
            bulge += len(contour) * REACH / 2.0
            continue
        points = contour[:, 0].astype(np.float32)
        around = np.concatenate([points[-REACH:], points, points[:REACH]])
        away = points - 0.5 * (around[: -2 * REACH] + around[2 * REACH :])
        bulge += float(np.sqrt(np.einsum("ij,ij->i", away, away)).sum())
    return GAIN * max(bulge / max(count, 1) - SMOOTH_PX, 0.0)
