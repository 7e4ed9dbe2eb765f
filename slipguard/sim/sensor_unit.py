"""The individual properties of one DIGIT sensor: LEDs, gel, scale, blur, noise, background image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

NOISE_STD_BGR = (2.9, 1.5, 2.4)
"""Temporal noise, gray levels, measured on two units."""
STRIPE_STD_BGR = (0.7, 0.4, 0.8)
"""Variation of whole columns between frames, gray levels; 0.65-1.6 measured on two units."""

Triple = tuple[float, float, float]


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
    gain_slope_mm: tuple[tuple[float, float], tuple[float, float], tuple[float, float]] = (
        (0.0, 0.0),
        (0.0, 0.0),
        (0.0, 0.0),
    )
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
        gain_slope_mm=(_pair(slopes[0]), _pair(slopes[1]), _pair(slopes[2])),
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
    return float(values[0]), float(values[1]), float(values[2])


def _pair(values: NDArray[np.float64]) -> tuple[float, float]:
    return float(values[0]), float(values[1])
