"""The gel under an object and its colors: a stretched membrane over an obstacle, cast shadows, shading by three LEDs.

The membrane and the shadows are computed on a grid of a quarter of the frame's resolution, the shading on pixels.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.devices import FRAME_HEIGHT_PX, FRAME_WIDTH_PX
from slipguard.sim.raster import Field, blurred, f32
from slipguard.sim.sensor_unit import SensorUnit

STEP_PX = 4
"""Frame pixels per cell of the grid, on each axis."""
_SWEEPS = (1.5, 1.0, 1.0, 0.6, 0.6, 0.35, 0.35)
"""Widths of the smoothing passes, in units of the unit's skirt, coarse to fine."""
_SHADOW_STRIDE = 2
_SHADOW_REACH = 26
"""Obstacles are searched for up to this many cells towards the LED: 5.6 mm."""
_GLOW_BLUR_PX = 6.0
Window = tuple[slice, slice]


def displaced_gel(overlap_mm: Field, unit: SensorUnit) -> Field:
    """Return the displacement of the gel towards the camera, mm, >= 0, on the grid of `overlap_mm`.

    The gel is pushed out of the object and smoothed alternately: the skirt joins the contact without a step, and the
    true contact is smaller than the geometric overlap, as in Hertz contact.

    Args:
        overlap_mm: > 0 where the rigid object would overlap the undeformed gel.
    """
    gel = np.maximum(overlap_mm, np.float32(0))
    sigma = unit.skirt_mm * unit.px_per_mm / STEP_PX
    for width in _SWEEPS:
        smooth = blurred(gel, sigma * width)
        smooth *= np.float32(unit.foundation**width)
        gel = np.maximum(overlap_mm, smooth, out=gel)
    return gel


def led_visibility(gel_mm: Field, unit: SensorUnit) -> list[Field]:
    """Return, per LED (B, G, R), the share of its light at each cell: 1 lit, 1 - unit.shadow in full shadow."""
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


class Shading:
    """LED fields of one unit on the frame and `margin_px` around it; windows count from the margin's corner."""

    def __init__(self, unit: SensorUnit, background: NDArray[np.uint8], margin_px: int) -> None:
        rows, columns = np.mgrid[-margin_px : FRAME_HEIGHT_PX + margin_px, -margin_px : FRAME_WIDTH_PX + margin_px]
        right = ((columns - (FRAME_WIDTH_PX - 1) / 2) / unit.px_per_mm).astype(np.float32)
        down = ((rows - (FRAME_HEIGHT_PX - 1) / 2) / unit.px_per_mm).astype(np.float32)
        long_radius_mm = unit.dome_radius_mm * unit.dome_aspect**2
        self.sag_mm = ((right**2 + down**2 / unit.dome_aspect**2) / (2.0 * unit.dome_radius_mm)).astype(np.float32)
        """Distance of the undeformed gel behind its crown, towards the camera."""
        self._mix = np.asarray(unit.crosstalk, np.float32)
        self._tilt = (right / np.float32(unit.dome_radius_mm), down / np.float32(long_radius_mm))
        self._slope_scale = unit.px_per_mm / 8.0
        glow = _glow(background, margin_px, unit.glow_share)
        self._leds = [self._led(unit, channel, right, down, glow[..., channel]) for channel in range(3)]
        flat = 1.0 / np.sqrt(self._tilt[0] ** 2 + self._tilt[1] ** 2 + 1.0)
        self._empty = [
            np.maximum((z - self._tilt[0] * x - self._tilt[1] * y) * flat, 0.0).astype(np.float32)
            for x, y, z in self._leds
        ]

    def _led(
        self, unit: SensorUnit, channel: int, right: Field, down: Field, glow: Field
    ) -> tuple[Field, Field, Field]:
        """Return the direction to one LED at every pixel (right, down, towards the camera), scaled by its intensity."""
        azimuth = math.radians(unit.led_azimuth_deg[channel])
        x = unit.led_radius_mm * math.cos(azimuth) - right
        y = -unit.led_radius_mm * math.sin(azimuth) - down
        z = unit.led_height_mm[channel] - self.sag_mm
        distance = np.sqrt(x * x + y * y + z * z)
        reference_mm = math.hypot(unit.led_radius_mm, unit.led_height_mm[channel])
        slope_right, slope_up = unit.gain_slope_mm[channel]
        gain = glow * unit.gain_bgr[channel] * np.maximum(1.0 + slope_right * right - slope_up * down, 0.1)
        strength = gain * (reference_mm / distance) ** unit.falloff / distance
        return (
            (x * strength).astype(np.float32),
            (y * strength).astype(np.float32),
            (z * strength).astype(np.float32),
        )

    def change(self, gel_mm: Field, visibility: list[Field], window: Window) -> Field:
        """Return the change of a displaced gel against the undeformed one, gray levels, (rows, columns, 3) float32 BGR.

        Args:
            gel_mm: displacement towards the camera on the window.
            visibility: share of each LED's light that reaches it.
        """
        slope_right = cv2.Sobel(gel_mm, cv2.CV_32F, 1, 0, scale=self._slope_scale)
        slope_down = cv2.Sobel(gel_mm, cv2.CV_32F, 0, 1, scale=self._slope_scale)
        slope_right += self._tilt[0][window]
        slope_down += self._tilt[1][window]
        norm = slope_right * slope_right
        norm += slope_down * slope_down
        norm += np.float32(1.0)
        np.sqrt(norm, out=norm)
        planes = []
        spare = np.empty_like(gel_mm)
        for (x, y, z), share, empty in zip(self._leds, visibility, self._empty, strict=True):
            light = slope_right * x[window]
            np.multiply(slope_down, y[window], out=spare)
            light += spare
            np.subtract(z[window], light, out=light)
            np.maximum(light, np.float32(0.0), out=light)
            light *= share
            light /= norm
            light -= empty[window]
            planes.append(light)
        return f32(cv2.transform(cv2.merge(planes), self._mix))


def _glow(background: NDArray[np.uint8], margin_px: int, share: float) -> Field:
    """Return how strongly each LED reaches each pixel, 1 on average, from the brightness of the background image."""
    wide = cv2.copyMakeBorder(background, margin_px, margin_px, margin_px, margin_px, cv2.BORDER_REPLICATE)
    smooth = blurred(f32(wide), _GLOW_BLUR_PX)
    return f32(np.float32(1.0 - share) + np.float32(share) * smooth / (smooth.mean(axis=(0, 1)) + np.float32(1.0)))
