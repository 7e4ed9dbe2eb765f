"""An object's height map as a raster, so that any pose of it is one image warp."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from slipguard.sim import objects
from slipguard.sim.raster import f32, reduced, warped

FLOOR_MM = -1.5
"""Heights are cut off here: the gel never reaches deeper."""
COARSE = 4
"""Pixels of the fine raster per pixel of the coarse one, on each axis."""


@dataclass(frozen=True, slots=True)
class HeightRaster:
    """Heights (mm, 0 at the top, >= -1.5) about an object's origin; beyond the raster its border goes on.

    fine: (n, n) float32, row 0 is up, `px_per_mm` pixels a mm, origin at the middle. coarse: fine, averaged 4 x 4.
    """

    fine: NDArray[np.float32]
    coarse: NDArray[np.float32]
    px_per_mm: float

    @classmethod
    def of(cls, height_mm: objects.HeightMap, half_mm: float = 16.0, px_per_mm: float = 20.0) -> HeightRaster:
        """Sample a height map on a square of 2 * half_mm."""
        n = COARSE * math.ceil(2.0 * half_mm * px_per_mm / COARSE)
        axis = (np.arange(n, dtype=np.float32) - (n - 1) / 2) / np.float32(px_per_mm)
        u, v = np.meshgrid(axis, -axis)
        fine = f32(np.maximum(height_mm(u, v), FLOOR_MM))
        return cls.from_raster(fine, px_per_mm)

    @classmethod
    def from_raster(cls, fine: NDArray[np.float32], px_per_mm: float) -> HeightRaster:
        """Take a square raster whose side is a multiple of 4."""
        n = fine.shape[0] // COARSE
        coarse = reduced(fine, (n, n))
        fine.setflags(write=False)
        coarse.setflags(write=False)
        return cls(fine, coarse, px_per_mm)

    def posed(
        self, to_object: NDArray[np.float64], size: tuple[int, int], *, coarse: bool = False
    ) -> NDArray[np.float32]:
        """Heights on a picture grid, (height, width) float32 mm.

        to_object: (2, 3), from pixel (column, row, 1) to object coordinates (u, v) in mm. size: (width, height).
        """
        raster = self.coarse if coarse else self.fine
        scale = self.px_per_mm / COARSE if coarse else self.px_per_mm
        middle = (raster.shape[0] - 1) / 2
        to_raster = np.array([[scale], [-scale]]) * to_object
        to_raster[:, 2] += middle
        return warped(raster, to_raster, size)


@lru_cache(maxsize=64)
def height_raster_of(name: str) -> HeightRaster:
    """The raster of a catalogue object, made once. Raises InputError for an unknown name."""
    return HeightRaster.of(objects.get(name).height_mm)
