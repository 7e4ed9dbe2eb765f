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
"""Object coordinates (right, up, frame pixels) to heights, frame pixels."""
LEVEL = 100.0
STRENGTH = 60.0
PRESSED_PX = 3.0
"""The scripted network calls contact what lies higher than this."""


@dataclass(frozen=True, slots=True)
class LedLights:
    """Three lights: strengths and azimuths (degrees counter-clockwise) of blue, green, red; uneven: relative change of
    their strength from the picture's middle to its edge, right and up.
    """

    gains: tuple[float, float, float] = (1.0, 1.0, 1.0)
    azimuths_deg: tuple[float, float, float] = (270.0, 150.0, 30.0)
    uneven: tuple[float, float] = (0.0, 0.0)


def ball(u: Heights, v: Heights) -> Heights:
    """Round, without texture."""
    return np.asarray(12.0 * np.exp(-(u * u + v * v) / (2.0 * 26.0**2)), np.float32)


def ring(u: Heights, v: Heights) -> Heights:
    """A round bead of a ring, without texture."""
    return np.asarray(9.0 * np.exp(-((np.hypot(u, v) - 34.0) ** 2) / (2.0 * 9.0**2)), np.float32)


def lettered(u: Heights, v: Heights) -> Heights:
    """A round contact with a bar and a dot on it."""
    bar = np.exp(-(np.maximum(np.abs(u + 10) - 3, 0) ** 2 + np.maximum(np.abs(v) - 22, 0) ** 2) / 18.0)
    dot = np.exp(-((u - 18) ** 2 + (v - 9) ** 2) / 60.0)
    return np.asarray(ball(u, v) + 4.0 * bar + 4.0 * dot, np.float32)


def plate(u: Heights, v: Heights) -> Heights:
    """A flat, oblong face with soft edges."""
    away = np.hypot(np.maximum(np.abs(u) - 38, 0), np.maximum(np.abs(v) - 14, 0))
    return np.asarray(9.0 * np.exp(-away * away / 120.0), np.float32)


def gear(u: Heights, v: Heights) -> Heights:
    """Twelve ribs around: it repeats every 30 degrees."""
    radius = np.hypot(u, v)
    ribs = 3.0 * np.cos(12 * np.arctan2(v, u)) * np.exp(-((radius - 40.0) ** 2) / 120.0)
    return np.asarray(ball(u, v) + ribs, np.float32)


def nut(u: Heights, v: Heights) -> Heights:
    """A hexagon's face with a hole: it repeats every 60 degrees."""
    sides = [np.abs(u * math.cos(a) + v * math.sin(a)) for a in np.radians((0.0, 60.0, 120.0))]
    away = np.maximum(np.maximum(np.maximum(sides[0], sides[1]), sides[2]) - 32.0, 0.0)
    hole = np.exp(-(u * u + v * v) / (2.0 * 11.0**2))
    return np.asarray(9.0 * np.exp(-away * away / 100.0) - 7.0 * hole, np.float32)


def heights(surface: Surface, rotation_deg: float, at: tuple[float, float], force: float) -> Heights:
    """A surface turned counter-clockwise about `at` (frame pixels right and down), (320, 240) float32."""
    rows, columns = np.mgrid[0:FRAME_HEIGHT_PX, 0:FRAME_WIDTH_PX].astype(np.float32)
    x, y = columns - np.float32(at[0]), np.float32(at[1]) - rows
    c, s = np.float32(math.cos(math.radians(rotation_deg))), np.float32(math.sin(math.radians(rotation_deg)))
    return np.asarray(np.float32(force) * surface(c * x + s * y, c * y - s * x), np.float32)


def drawn(height: Heights, lights: LedLights, noise: float, rng: np.random.Generator) -> Image:
    """The frame of a pressed surface: what slopes towards a light is brighter in its colour."""
    down, right = np.gradient(height)
    y, x = np.mgrid[1.0:-1.0:320j, -1.0:1.0:240j]
    even = 1.0 + lights.uneven[0] * x + lights.uneven[1] * y
    azimuth = np.radians(lights.azimuths_deg)
    change = [g * even * (right * np.cos(a) - down * np.sin(a)) for g, a in zip(lights.gains, azimuth, strict=True)]
    levels = LEVEL - STRENGTH * np.stack(change, axis=-1) + noise * rng.standard_normal((320, 240, 3))
    return np.asarray(np.clip(np.rint(levels), 0, 255), np.uint8)


def contact(height: Heights) -> NDArray[np.float32]:
    """What a network would answer, (160, 120) float32."""
    return np.asarray(1.0 / (1.0 + np.exp(PRESSED_PX - height[::2, ::2])), np.float32)
