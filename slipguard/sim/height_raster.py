"""An object's height map as a raster, so that any pose of it is one image warp."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.sim.catalogue import find_object
from slipguard.sim.raster import Field, f32, reduced, warped
from slipguard.sim.sim_object import HeightMap

FLOOR_MM = -1.5
"""Heights are cut off here: the gel never reaches deeper, unless the object is tilted."""
COARSE = 4
"""Pixels of the fine raster per pixel of the coarse one, on each axis."""


@dataclass(frozen=True, slots=True)
class HeightRaster:
    """Heights (mm, 0 at the top, >= -1.5) about an object's origin; the border values extend outwards.

    Attributes:
        fine: (n, n) float32, row 0 is up, `px_per_mm` pixels per mm, origin at the center.
        coarse: `fine` averaged over 4 x 4 pixels.
    """

    fine: NDArray[np.float32]
    coarse: NDArray[np.float32]
    px_per_mm: float

    @classmethod
    def of(
        cls, height_mm: HeightMap, half_mm: float = 16.0, px_per_mm: float = 20.0, floor_mm: float = FLOOR_MM
    ) -> HeightRaster:
        """Sample a height map on a square of side 2 * half_mm."""
        n = COARSE * math.ceil(2.0 * half_mm * px_per_mm / COARSE)
        axis = (np.arange(n, dtype=np.float32) - (n - 1) / 2) / np.float32(px_per_mm)
        u, v = np.meshgrid(axis, -axis)
        return cls.from_raster(f32(np.maximum(height_mm(u, v), np.float32(floor_mm))), px_per_mm)

    @classmethod
    def from_raster(cls, fine: NDArray[np.float32], px_per_mm: float) -> HeightRaster:
        """Make one from a square raster whose side is a multiple of 4."""
        n = fine.shape[0] // COARSE
        coarse = reduced(fine, (n, n))
        fine.setflags(write=False)
        coarse.setflags(write=False)
        return cls(fine, coarse, px_per_mm)

    def posed(
        self, to_object: NDArray[np.float64], size: tuple[int, int], *, coarse: bool = False
    ) -> NDArray[np.float32]:
        """Return the heights on an image grid, (height, width) float32 mm.

        Args:
            to_object: (2, 3), from pixel (column, row, 1) to object coordinates (u, v) in mm.
            size: (width, height).
        """
        raster, scale, middle = self._level(coarse=coarse)
        to_raster = np.array([[scale], [-scale]]) * to_object
        to_raster[:, 2] += middle
        return warped(raster, to_raster, size)

    def sampled(self, u_mm: Field, v_mm: Field, *, coarse: bool = False) -> Field:
        """Return the heights at object coordinates, float32 mm."""
        raster, scale, middle = self._level(coarse=coarse)
        columns, rows = u_mm * np.float32(scale) + np.float32(middle), v_mm * np.float32(-scale) + np.float32(middle)
        return f32(cv2.remap(raster, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))

    def _level(self, *, coarse: bool) -> tuple[Field, float, float]:
        """Return a raster, its pixels per mm and its middle pixel."""
        raster = self.coarse if coarse else self.fine
        return raster, self.px_per_mm / COARSE if coarse else self.px_per_mm, (raster.shape[0] - 1) / 2


@lru_cache(maxsize=64)
def height_raster_of(name: str, floor_mm: float = FLOOR_MM) -> HeightRaster:
    """Return the raster of a catalogue object, computed once. Raises InputError for an unknown name."""
    return HeightRaster.of(find_object(name).height_mm, floor_mm=floor_mm)
