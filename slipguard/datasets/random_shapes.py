"""Random surfaces to press: a few simple bodies side by side, so that training covers more than the catalogue."""

from __future__ import annotations

import math
from collections.abc import Callable

import cv2
import numpy as np

from slipguard.sim import shapes as s
from slipguard.sim.height_raster import FLOOR_MM, HeightRaster
from slipguard.sim.raster import Field, f32, warped

HALF_MM = 11.0
PX_PER_MM = 12.0
_Body = Callable[[Field, Field, np.random.Generator], Field]


def composition(rng: np.random.Generator) -> HeightRaster:
    """Return two to four bodies at random positions and angles, sometimes textured. Highest point near 0."""

    def height_mm(u: Field, v: Field) -> Field:
        bodies = []
        for _ in range(int(rng.integers(2, 5))):
            place = (float(rng.normal(0.0, 2.2)), float(rng.normal(0.0, 1.6)))
            x, y = s.rotated(u, v, float(rng.uniform(0.0, 180.0)), place)
            body = _BODIES[int(rng.integers(len(_BODIES)))](x, y, rng)
            bodies.append(body - np.float32(rng.uniform(0.0, 0.25)))
        height = s.highest(*bodies)
        if rng.random() < 0.3:
            height = height - _texture(u, v, rng)
        return f32(height - height.max())

    return HeightRaster.of(height_mm, HALF_MM, PX_PER_MM)


def broad(rng: np.random.Generator) -> HeightRaster:
    """Return a bottle, can or handle: curved across, nearly straight along, with soft or cut ends."""
    across_mm, along_mm = float(rng.uniform(4.0, 25.0)), math.exp(rng.uniform(math.log(15.0), math.log(200.0)))
    half_mm, fall = float(rng.uniform(3.0, 11.0)), float(rng.uniform(0.15, 1.5))

    def height_mm(u: Field, v: Field) -> Field:
        curved = v * v / np.float32(2.0 * across_mm) + u * u / np.float32(2.0 * along_mm)
        return f32(-curved - np.float32(fall) * np.maximum(np.abs(u) - np.float32(half_mm), 0.0))

    return HeightRaster.of(height_mm, HALF_MM, PX_PER_MM)


def resized(raster: HeightRaster, factor: float) -> HeightRaster:
    """Return the same surface, `factor` times as long and wide."""
    return HeightRaster(raster.fine, raster.coarse, raster.px_per_mm / factor)


def roughened(raster: HeightRaster, rng: np.random.Generator, std_mm: float) -> HeightRaster:
    """Return the surface with smooth random heights added, correlated over about a millimeter."""
    n = raster.fine.shape[0]
    cells = max(int(n / raster.px_per_mm / rng.uniform(0.4, 1.6)), 4)
    bumps = rng.standard_normal((cells, cells), dtype=np.float32) * np.float32(std_mm)
    return HeightRaster.from_raster(raster.fine + f32(cv2.resize(bumps, (n, n))), raster.px_per_mm)


def with_neighbor(raster: HeightRaster, other: HeightRaster, rng: np.random.Generator) -> HeightRaster:
    """Return both surfaces as one body, the other rotated, 4-9 mm away and up to 0.3 mm lower."""
    n = raster.fine.shape[0]
    middle, angle = (n - 1) / 2, float(rng.uniform(0.0, 2 * math.pi))
    distance = float(rng.uniform(4.0, 9.0)) * raster.px_per_mm
    place = (middle + distance * math.cos(angle), middle + distance * math.sin(angle))
    to_other = cv2.getRotationMatrix2D(place, float(rng.uniform(0.0, 360.0)), other.px_per_mm / raster.px_per_mm)
    to_other[:, 2] += (other.fine.shape[0] - 1) / 2 - np.array(place)
    second = warped(other.fine, np.asarray(to_other, np.float64), (n, n)) - np.float32(rng.uniform(0.0, 0.3))
    return HeightRaster.from_raster(f32(np.maximum(raster.fine, np.maximum(second, FLOOR_MM))), raster.px_per_mm)


def _block(u: Field, v: Field, rng: np.random.Generator) -> Field:
    long, wide = rng.uniform(0.8, 4.5), rng.uniform(0.6, 2.2)
    return s.plateau(s.box(u, v, long, wide, corner=float(rng.uniform(0, 0.5))), float(rng.uniform(0.2, 0.6)))


def _disc(u: Field, v: Field, rng: np.random.Generator) -> Field:
    return s.plateau(s.disc(u, v, float(rng.uniform(0.8, 3.0))), float(rng.uniform(0.2, 0.6)))


def _dome(u: Field, v: Field, rng: np.random.Generator) -> Field:
    long, wide = np.float32(rng.uniform(1.0, 5.0)), np.float32(rng.uniform(0.8, 2.5))
    return f32(np.float32(-rng.uniform(0.6, 1.5)) * ((u / long) ** 2 + (v / wide) ** 2))


def _pill(u: Field, v: Field, rng: np.random.Generator) -> Field:
    half = float(rng.uniform(0.5, 4.5))
    return s.cylinder(s.path(u, v, [(-half, 0.0), (half, 0.0)], 0.0), float(rng.uniform(0.7, 3.0)))


def _facet(u: Field, v: Field, rng: np.random.Generator) -> Field:
    angles = np.sort(rng.uniform(0.0, 2 * math.pi, int(rng.integers(3, 7))))
    radii = rng.uniform(1.2, 4.0, angles.size)
    corners = [(float(r * math.cos(a)), float(r * math.sin(a))) for r, a in zip(radii, angles, strict=True)]
    return s.plateau(s.polygon(u, v, corners), float(rng.uniform(0.15, 0.5)))


def _bow(u: Field, v: Field, rng: np.random.Generator) -> Field:
    start = float(rng.uniform(0.0, 360.0))
    line = s.arc(float(rng.uniform(1.5, 5.0)), start, start + float(rng.uniform(60.0, 300.0)), count=9)
    return s.cylinder(s.path(u, v, line, 0.0), float(rng.uniform(0.5, 1.4)))


_BODIES: tuple[_Body, ...] = (_block, _disc, _dome, _pill, _facet, _bow)


def _texture(u: Field, v: Field, rng: np.random.Generator) -> Field:
    period, depth = float(rng.uniform(0.7, 2.2)), float(rng.uniform(0.05, 0.35))
    u, v = s.rotated(u, v, float(rng.uniform(0.0, 180.0)))
    return s.grooves(u, period, depth) if rng.random() < 0.6 else s.knurl(u, v, period, depth)
