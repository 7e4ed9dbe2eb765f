"""Colours of a gel surface under a unit's three lights, as the change against the undeformed gel."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.sim.raster import Field, blurred, f32
from slipguard.sim.unit import FRAME_HEIGHT_PX, FRAME_WIDTH_PX, SensorUnit

_GLOW_BLUR_PX = 6.0
Window = tuple[slice, slice]


class Shading:
    """Light fields of one unit on the frame and `margin_px` around it; windows count from the margin's corner."""

    def __init__(self, unit: SensorUnit, background: NDArray[np.uint8], margin_px: int) -> None:
        rows, columns = np.mgrid[-margin_px : FRAME_HEIGHT_PX + margin_px, -margin_px : FRAME_WIDTH_PX + margin_px]
        right = ((columns - (FRAME_WIDTH_PX - 1) / 2) / unit.px_per_mm).astype(np.float32)
        down = ((rows - (FRAME_HEIGHT_PX - 1) / 2) / unit.px_per_mm).astype(np.float32)
        self.sag_mm = ((right**2 + down**2) / (2.0 * unit.dome_radius_mm)).astype(np.float32)
        """How far the undeformed gel lies behind its crown, towards the camera."""
        self._mix = np.asarray(unit.crosstalk, np.float32)
        self._tilt = (right / np.float32(unit.dome_radius_mm), down / np.float32(unit.dome_radius_mm))
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
        """Direction to one light at every pixel (right, down, towards the camera), scaled with its strength there."""
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

    def change(self, gel_mm: Field, lit: list[Field], window: Window) -> Field:
        """Grey levels by which a displaced gel differs from the undeformed one, (rows, columns, 3) float32 BGR.

        gel_mm: displacement towards the camera on the window. lit: share of each light that reaches it.
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
        for (x, y, z), share, empty in zip(self._leds, lit, self._empty, strict=True):
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
    """How strongly each light reaches each pixel, 1 on average: where the no-contact image is bright in its colour."""
    wide = cv2.copyMakeBorder(background, margin_px, margin_px, margin_px, margin_px, cv2.BORDER_REPLICATE)
    smooth = blurred(f32(wide), _GLOW_BLUR_PX)
    return f32(np.float32(1.0 - share) + np.float32(share) * smooth / (smooth.mean(axis=(0, 1)) + np.float32(1.0)))
