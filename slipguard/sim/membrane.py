"""The gel under an object: a stretched membrane over an obstacle, and the shadows it casts. On a quarter-size grid."""

from __future__ import annotations

import math

import cv2
import numpy as np

from slipguard.sim.raster import Field, blurred, f32
from slipguard.sim.unit import SensorUnit

STEP_PX = 4
"""Frame pixels per cell of the grid, on each axis."""
_SWEEPS = (1.5, 1.0, 1.0, 0.6, 0.6, 0.35, 0.35)
"""Widths of the smoothing passes in units of the unit's skirt, coarse to fine."""
_SHADOW_STRIDE = 2
_SHADOW_REACH = 26
"""Shadows are sought this many cells towards the light: 5.6 mm."""


def settle(overlap_mm: Field, unit: SensorUnit) -> Field:
    """Where the gel comes to rest, mm towards the camera, >= 0, same grid as `overlap_mm`.

    overlap_mm: > 0 where the rigid object would overlap the undeformed gel. The gel is pushed out of the object and
    smoothed, in turns: the skirt joins the contact without a step, and the true contact is smaller than the
    geometric overlap, as in Hertz's.
    """
    gel = np.maximum(overlap_mm, np.float32(0))
    sigma = unit.skirt_mm * unit.px_per_mm / STEP_PX
    for width in _SWEEPS:
        smooth = blurred(gel, sigma * width)
        smooth *= np.float32(unit.foundation**width)
        gel = np.maximum(overlap_mm, smooth, out=gel)
    return gel


def lit(gel_mm: Field, unit: SensorUnit) -> list[Field]:
    """Share of each light (B, G, R) that reaches each cell past the gel's own hills: 1 free, 1 - unit.shadow dark."""
    cell_mm = STEP_PX / unit.px_per_mm
    height, width = gel_mm.shape
    top_mm = float(gel_mm.max())
    pad = _SHADOW_REACH + 1
    wide = f32(cv2.copyMakeBorder(gel_mm, pad, pad, pad, pad, cv2.BORDER_CONSTANT, value=(0.0,)))
    shares = []
    for azimuth_deg, led_height_mm in zip(unit.led_azimuth_deg, unit.led_height_mm, strict=True):
        right, down = math.cos(math.radians(azimuth_deg)), -math.sin(math.radians(azimuth_deg))
        rise_mm = cell_mm * led_height_mm / unit.led_radius_mm
        horizon = gel_mm.copy()
        for k in range(_SHADOW_STRIDE, _SHADOW_REACH + 1, _SHADOW_STRIDE):
            if k * rise_mm >= top_mm:
                break
            row, column = pad + round(k * down), pad + round(k * right)
            hill = wide[row : row + height, column : column + width] - np.float32(k * rise_mm)
            np.maximum(horizon, hill, out=horizon)
        horizon -= gel_mm
        horizon *= np.float32(-unit.shadow / unit.shadow_soft_mm)
        np.maximum(horizon, np.float32(-unit.shadow), out=horizon)
        horizon += np.float32(1.0)
        shares.append(blurred(horizon, 1.0))
    return shares
