"""Procedural background images: glow of the LEDs, streaks, dust, vignette."""

from __future__ import annotations

import math
from typing import cast

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.devices import FRAME_HEIGHT_PX, FRAME_WIDTH_PX
from slipguard.sim.raster import Field, blurred, f32
from slipguard.sim.sensor_unit import SensorUnit

_BLEED = ((0.80, 0.20, 0.12), (0.16, 0.80, 0.12), (0.12, 0.16, 0.80))
"""Mixing of the three colors by lights and filters."""


def background_image(unit: SensorUnit) -> NDArray[np.uint8]:
    """Return a unit's background image, (320, 240, 3) BGR: its real one, or a procedural one from its LEDs and seed."""
    if unit.background is not None:
        return unit.background
    rng = np.random.default_rng(unit.background_seed)
    rows, columns = np.mgrid[0:FRAME_HEIGHT_PX, 0:FRAME_WIDTH_PX].astype(np.float32)
    x = columns / (FRAME_WIDTH_PX - 1) * 2 - 1
    y = 1 - rows / (FRAME_HEIGHT_PX - 1) * 2
    crisp = rng.random() < 0.4  # on some gels the edge of a light cone is visible
    planes = [_glow(rng, x, y, azimuth, crisp) + _streaks(rng, x, y, azimuth) for azimuth in unit.led_azimuth_deg]
    image = f32(cv2.transform(cv2.merge(planes), np.asarray(_BLEED, np.float32)))
    image *= (1 - rng.uniform(0.05, 0.35) * (x * x + y * y) / 2)[..., None]
    _dust(rng, image)
    image = blurred(image, 1.2) * rng.uniform(0.75, 1.2)
    stripes = rng.normal(0.0, rng.uniform(0.0, 1.2), (1, FRAME_WIDTH_PX, 3))
    return np.clip(np.rint(image + stripes), 5, 250).astype(np.uint8)


def _glow(rng: np.random.Generator, x: Field, y: Field, azimuth_deg: float, crisp: bool) -> Field:
    """Return the glow of one LED: bright on the opposite side, where the dome tilts towards it."""
    glow = np.full(x.shape, rng.uniform(20, 75), np.float32)
    for k in range(int(rng.integers(2, 4))):
        away = 180.0 if k == 0 or rng.random() < 0.6 else 0.0
        angle = math.radians(azimuth_deg + away + rng.normal(0, 28))
        distance, wide, high = rng.uniform(0.35, 1.15), rng.uniform(0.35, 1.0), rng.uniform(0.35, 1.0)
        strength = rng.uniform(40, 120) * (1.0 if k == 0 else 0.5)
        square = ((x - distance * math.cos(angle)) / wide) ** 2 + ((y - distance * math.sin(angle)) / high) ** 2
        if crisp and k == 0:
            edge = rng.uniform(0.04, 0.2)
            share = 1.0 / (1.0 + np.exp(np.clip((np.sqrt(square) - 1.3) / edge, -30.0, 30.0)))
            glow += (strength * share * (1.0 - 0.25 * np.minimum(square, 3.0))).astype(np.float32)
        else:
            glow += (strength * np.exp(-0.5 * square)).astype(np.float32)
    slow = rng.standard_normal((5, 4)).astype(np.float32) * np.float32(rng.uniform(0, 8))
    glow += cv2.resize(slow, (FRAME_WIDTH_PX, FRAME_HEIGHT_PX), interpolation=cv2.INTER_CUBIC)
    return glow


def _streaks(rng: np.random.Generator, x: Field, y: Field, azimuth_deg: float) -> Field:
    """Return light through flaws of the gel's edge: a fan of soft rays from the LED that fade with distance."""
    angle = math.radians(azimuth_deg + rng.normal(0, 10))
    source = (1.5 * math.cos(angle), 1.15 * math.sin(angle))
    right, up = x - np.float32(source[0]), (y - np.float32(source[1])) * np.float32(FRAME_HEIGHT_PX / FRAME_WIDTH_PX)
    bearing = np.arctan2(
        right * np.float32(-math.sin(angle)) + up * np.float32(math.cos(angle)),
        -(right * np.float32(math.cos(angle)) + up * np.float32(math.sin(angle))),
    )
    rays = np.maximum(rng.standard_normal(64), 0.0) ** 2
    rays = np.convolve(rays, np.hanning(int(rng.integers(4, 14))), "same") * rng.uniform(0.0, 14.0)
    reach = rng.uniform(0.4, 1.6)
    fade = np.exp(-np.hypot(right, up) / np.float32(reach))
    return f32(f32(np.interp(bearing, np.linspace(-1.3, 1.3, rays.size), rays)) * fade)


def _dust(rng: np.random.Generator, image: Field) -> None:
    """Draw specks and flaws of the paint into the image."""
    for _ in range(int(rng.integers(0, 6))):
        column, row = int(rng.integers(8, FRAME_WIDTH_PX - 8)), int(rng.integers(8, FRAME_HEIGHT_PX - 8))
        color = image[row, column] + rng.normal(0, 40, 3)
        radius = int(rng.integers(1, 3))
        cv2.circle(image, (column, row), radius, cast("tuple[float, float, float]", tuple(color.tolist())), -1)
