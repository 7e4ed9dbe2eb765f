"""The individual properties of one DIGIT sensor, its background image, and the noise of its camera."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import cast

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.devices import FRAME_HEIGHT_PX, FRAME_WIDTH_PX
from slipguard.sim.raster import Field, blurred, f32

NOISE_STD_BGR = (2.9, 1.5, 2.4)
"""Temporal noise, gray levels, measured on two units."""
STRIPE_STD_BGR = (0.7, 0.4, 0.8)
"""Variation of whole columns between frames, gray levels; 0.65-1.6 measured on two units."""

Triple = tuple[float, float, float]
Slopes = tuple[tuple[float, float], tuple[float, float], tuple[float, float]]


@dataclass(frozen=True, slots=True)
class SensorUnit:
    """Optics and gel of one sensor. Picklable; triples are in the order blue, green, red.

    The defaults are fitted to 15 real presses of a ball: difference images correlate 0.89 with 15 held-out presses.

    Attributes:
        px_per_mm: 18.15-18.63 on four units with a caliper, 15.9-19.6 across sources.
        dome_radius_mm: curvature of the gel towards the object, across its short side; infinite for a flat gel.
        dome_aspect: length over width of a dome's height lines: above 1 it is long in the image's vertical direction.
        dome_share: share of the dome's sag that affects a flat object (0-1).
        led_azimuth_deg: counter-clockwise from the image's right.
        led_radius_mm, led_height_mm: from the gel's crown.
        gain_bgr: gray levels of a surface that faces the LED.
        gain_slope_mm: relative change of gain per mm to the right and per mm up, per LED.
        glow_share: how much an LED's local intensity follows the background image's brightness (0-1).
        crosstalk: rows are the channels, columns the LEDs.
        falloff: intensity is proportional to 1 / distance^falloff.
        skirt_mm: width of the gel's slope around a contact.
        foundation: restoring factor of the gel (1: none).
        shadow: darkness of a cast shadow, 0-1.
        shadow_soft_mm: depth below the shadow's edge at which it is full.
        psf_px: standard deviation of the camera's blur.
        noise_bgr, stripe_bgr: standard deviations of pixels and of whole columns, gray levels.
        background_seed: seed of the procedural background image.
        background: a real background image instead, (320, 240, 3) uint8.
    """

    px_per_mm: float = 18.5
    dome_radius_mm: float = 90.0
    dome_share: float = 0.15
    dome_aspect: float = 1.0
    led_azimuth_deg: Triple = (260.3, 138.3, 38.3)
    led_radius_mm: float = 20.0
    led_height_mm: Triple = (3.91, 5.04, 4.82)
    gain_bgr: Triple = (170.3, 112.3, 249.6)
    gain_slope_mm: Slopes = ((0.0, 0.0), (0.0, 0.0), (0.0, 0.0))
    glow_share: float = 1.0
    crosstalk: tuple[Triple, Triple, Triple] = ((1.0, -0.4, 0.063), (0.353, 1.0, 0.043), (0.376, 0.44, 1.0))
    falloff: float = 0.0
    skirt_mm: float = 0.647
    foundation: float = 0.931
    shadow: float = 0.134
    shadow_soft_mm: float = 0.272
    psf_px: float = 2.2
    noise_bgr: Triple = NOISE_STD_BGR
    stripe_bgr: Triple = STRIPE_STD_BGR
    background_seed: int = 0
    background: NDArray[np.uint8] | None = field(default=None, compare=False, repr=False)


@dataclass(frozen=True, slots=True)
class LightChange:
    """Change of the light since the background image was taken.

    image -> gain * image + offset_bgr + tilt_bgr * x + tilt_up_bgr * y, with x from -1 (left) to 1 (right) and y
    from -1 (bottom) to 1 (top). Gray levels.
    """

    gain: float = 1.0
    offset_bgr: Triple = (0.0, 0.0, 0.0)
    tilt_bgr: Triple = (0.0, 0.0, 0.0)
    tilt_up_bgr: Triple = (0.0, 0.0, 0.0)


def random_unit(rng: np.random.Generator, backgrounds: Sequence[NDArray[np.uint8]] | None = None) -> SensorUnit:
    """Return a random sensor unit; the ranges cover the known variation between units and more.

    A quarter of the units have their LEDs in another order, a quarter are mirrored.

    Args:
        backgrounds: real background images, used for half of the units; the others get a procedural one.
    """
    azimuth_deg = np.array([270.0, 150.0, 30.0]) + rng.normal(0.0, 8.0, 3)
    if rng.random() < 0.25:
        azimuth_deg = azimuth_deg[rng.permutation(3)]
    if rng.random() < 0.25:
        azimuth_deg = 180.0 - azimuth_deg
    mix = np.eye(3) + rng.uniform(-0.25, 0.35, (3, 3)) * (1.0 - np.eye(3))
    slopes = rng.normal(0.0, 0.02, (3, 2))
    background = None
    if backgrounds and rng.random() < 0.5:
        background = backgrounds[int(rng.integers(len(backgrounds)))]
    return SensorUnit(
        px_per_mm=float(rng.uniform(15.5, 20.0)),
        dome_radius_mm=float(rng.uniform(25.0, 90.0)),
        dome_share=float(rng.uniform(0.0, 0.3)),
        led_azimuth_deg=_triple(azimuth_deg),
        led_height_mm=_triple(rng.uniform(3.5, 13.0, 3)),
        gain_bgr=_triple(rng.uniform(70.0, 200.0) * rng.uniform(0.75, 1.25, 3)),
        gain_slope_mm=cast("Slopes", tuple(map(tuple, slopes.tolist()))),
        glow_share=float(rng.uniform(0.0, 1.0)),
        crosstalk=(_triple(mix[0]), _triple(mix[1]), _triple(mix[2])),
        falloff=float(rng.uniform(0.0, 2.0)),
        skirt_mm=float(rng.uniform(0.25, 0.8)),
        foundation=float(rng.uniform(0.8, 0.97)),
        shadow=float(rng.uniform(0.0, 0.95)),
        shadow_soft_mm=float(rng.uniform(0.06, 0.5)),
        psf_px=float(rng.uniform(0.8, 3.2)),
        noise_bgr=_triple(np.array(NOISE_STD_BGR) * rng.uniform(0.3, 1.6)),
        stripe_bgr=_triple(np.array(STRIPE_STD_BGR) * rng.uniform(0.0, 1.6)),
        background_seed=int(rng.integers(2**31)),
        background=background,
    )


def _triple(values: NDArray[np.float64]) -> Triple:
    return cast("Triple", tuple(values.tolist()))


# The background image.

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


# The noise.

_CORRELATION_PX = 0.79
"""Blur of white noise that gives the measured lag-1 correlation of 0.65, exp(-1 / (4 s^2)), rounding included."""
_STRIPE_PX = 1.5
"""Neighboring columns drift together."""
_ARRAYS = 4


class CameraNoise:
    """Noise of one camera; the sequence of frames depends on the seed only."""

    def __init__(self, std_bgr: Triple, stripe_bgr: Triple, seed: int) -> None:
        noise, stripes = _noise_arrays(seed % _ARRAYS)
        self._array = noise * np.asarray(std_bgr, np.float32) + stripes * np.asarray(stripe_bgr, np.float32)
        self._rng = np.random.default_rng(seed)

    def reseed(self, seed: int) -> None:
        self._rng = np.random.default_rng(seed)

    def next(self) -> Field:
        """Return the next frame of noise, (320, 240, 3) float32 gray levels; read-only by convention."""
        height, width = self._array.shape[:2]
        top = int(self._rng.integers(height - FRAME_HEIGHT_PX + 1))
        left = int(self._rng.integers(width - FRAME_WIDTH_PX + 1))
        return self._array[top : top + FRAME_HEIGHT_PX, left : left + FRAME_WIDTH_PX]


@lru_cache(maxsize=_ARRAYS)
def _noise_arrays(index: int) -> tuple[Field, Field]:
    """Return pixel noise (640, 480, 3) and column noise (1, 480, 3), both of standard deviation 1."""
    rng = np.random.default_rng([20479, index])
    white = rng.standard_normal((2 * FRAME_HEIGHT_PX, 2 * FRAME_WIDTH_PX, 3), dtype=np.float32)
    noise = blurred(white, _CORRELATION_PX)
    noise /= noise.std(axis=(0, 1))
    white = rng.standard_normal((1, 2 * FRAME_WIDTH_PX, 3), dtype=np.float32)
    stripes = blurred(white, _STRIPE_PX)
    stripes /= stripes.std(axis=(0, 1))
    return noise, stripes
