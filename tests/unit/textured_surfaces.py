"""Pressed surfaces shaded by three lights, without the renderer: fast, and exact in angle."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slipguard.devices import FRAME_HEIGHT_PX, FRAME_WIDTH_PX

Image = NDArray[np.uint8]
Heights = NDArray[np.float32]
Surface = Callable[[Heights, Heights], Heights]
"""Maps object coordinates (right, up, in frame pixels) to heights in frame pixels."""
LEVEL = 100.0
STRENGTH = 60.0
PRESSED_PX = 3.0
"""The scripted network reports contact above this height."""


@dataclass(frozen=True, slots=True)
class LedLights:
    """Blue, green and red light: strengths, azimuths (degrees counter-clockwise) and unevenness.

    uneven: relative change of the strength from the center of the image to its right and upper edge.
    """

    gains: tuple[float, float, float] = (1.0, 1.0, 1.0)
    azimuths_deg: tuple[float, float, float] = (270.0, 150.0, 30.0)
    uneven: tuple[float, float] = (0.0, 0.0)


def ball(u: Heights, v: Heights) -> Heights:
    """A round contact without texture."""
    return np.asarray(12.0 * np.exp(-(u * u + v * v) / (2.0 * 26.0**2)), np.float32)


def ring(u: Heights, v: Heights) -> Heights:
    """A ring with a round profile, without texture."""
    return np.asarray(9.0 * np.exp(-((np.hypot(u, v) - 34.0) ** 2) / (2.0 * 9.0**2)), np.float32)


def lettered(u: Heights, v: Heights) -> Heights:
    """A round contact with a bar and a dot on it."""
    bar = np.exp(-(np.maximum(np.abs(u + 10) - 3, 0) ** 2 + np.maximum(np.abs(v) - 22, 0) ** 2) / 18.0)
    dot = np.exp(-((u - 18) ** 2 + (v - 9) ** 2) / 60.0)
    return np.asarray(ball(u, v) + 4.0 * bar + 4.0 * dot, np.float32)


def plate(u: Heights, v: Heights) -> Heights:
    """A flat, elongated face with soft edges."""
    away = np.hypot(np.maximum(np.abs(u) - 38, 0), np.maximum(np.abs(v) - 14, 0))
    return np.asarray(9.0 * np.exp(-away * away / 120.0), np.float32)


def toothed(teeth: int) -> Surface:
    """Return a gear with a number of teeth: its period is 360 degrees over that."""

    def surface(u: Heights, v: Heights) -> Heights:
        ribs = 3.0 * np.cos(teeth * np.arctan2(v, u)) * np.exp(-((np.hypot(u, v) - 40.0) ** 2) / 120.0)
        return np.asarray(ball(u, v) + ribs, np.float32)

    return surface


gear = toothed(12)
gear.__name__ = "gear"


def nut(u: Heights, v: Heights) -> Heights:
    """A hexagonal nut with a hole: its period is 60 degrees."""
    sides = [np.abs(u * math.cos(a) + v * math.sin(a)) for a in np.radians((0.0, 60.0, 120.0))]
    away = np.maximum(np.maximum(np.maximum(sides[0], sides[1]), sides[2]) - 32.0, 0.0)
    hole = np.exp(-(u * u + v * v) / (2.0 * 11.0**2))
    return np.asarray(9.0 * np.exp(-away * away / 100.0) - 7.0 * hole, np.float32)


def heights(surface: Surface, rotation_deg: float, at: tuple[float, float], force: float) -> Heights:
    """Return the heights of a surface rotated counter-clockwise about `at` (x, y in frame pixels), (320, 240)."""
    rows, columns = np.mgrid[0:FRAME_HEIGHT_PX, 0:FRAME_WIDTH_PX].astype(np.float32)
    x, y = columns - np.float32(at[0]), np.float32(at[1]) - rows
    c, s = np.float32(math.cos(math.radians(rotation_deg))), np.float32(math.sin(math.radians(rotation_deg)))
    return np.asarray(np.float32(force) * surface(c * x + s * y, c * y - s * x), np.float32)


def shaded_image(height: Heights, lights: LedLights, noise: float, rng: np.random.Generator) -> Image:
    """Return the camera image of a pressed surface: a slope towards a light is brighter in its color."""
    down, right = np.gradient(height)
    y, x = np.mgrid[1.0:-1.0:320j, -1.0:1.0:240j]
    even = 1.0 + lights.uneven[0] * x + lights.uneven[1] * y
    azimuth = np.radians(lights.azimuths_deg)
    change = [g * even * (right * np.cos(a) - down * np.sin(a)) for g, a in zip(lights.gains, azimuth, strict=True)]
    levels = LEVEL - STRENGTH * np.stack(change, axis=-1) + noise * rng.standard_normal((320, 240, 3))
    return np.asarray(np.clip(np.rint(levels), 0, 255), np.uint8)


def contact_map(height: Heights) -> NDArray[np.float32]:
    """Return the probability map of the contact, (160, 120) float32."""
    return np.asarray(1.0 / (1.0 + np.exp(PRESSED_PX - height[::2, ::2])), np.float32)
