"""Long shafts that slide along their axis through a grasp: plain, ribbed and threaded."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from slipguard.sim import shapes
from slipguard.sim.height_raster import HeightRaster
from slipguard.sim.raster import Field, f32

HALF_LENGTH_MM = 48.0
"""A slide of 30 mm stays within the raster."""
THREAD_SHARE = 0.6134
"""Depth of an ISO metric thread over its pitch (ISO 68-1). Pitches: M5 0.8 mm, M8 1.25, M10 1.5, M16 2.0 (ISO 261)."""


@dataclass(frozen=True, slots=True)
class Shaft:
    """A shaft along the object's u axis.

    Attributes:
        radius_mm: of its surface.
        pitch_mm: distance of its grooves; 0 for a plain one.
        groove_mm: depth of the grooves; None: that of a thread.
        threaded: the grooves wind around it once per pitch, so that they cross the axis at an angle.
        end_mm: where it ends on the +u side; infinite for none.
    """

    radius_mm: float = 5.0
    pitch_mm: float = 0.0
    groove_mm: float | None = None
    threaded: bool = False
    end_mm: float = math.inf

    def heights_mm(self, u: Field, v: Field) -> Field:
        height = shapes.cylinder(v, self.radius_mm)
        if self.pitch_mm > 0.0:
            depth_mm = THREAD_SHARE * self.pitch_mm if self.groove_mm is None else self.groove_mm
            around = np.arcsin(np.clip(v / np.float32(self.radius_mm), -1.0, 1.0)) / np.float32(2.0 * math.pi)
            along = u - np.float32(self.pitch_mm) * f32(around) if self.threaded else u
            height = height - shapes.grooves(along, self.pitch_mm, depth_mm)
        return shapes.lowered(f32(height), f32(u - np.float32(min(self.end_mm, 2.0 * HALF_LENGTH_MM))))

    def raster(self) -> HeightRaster:
        """Return the raster for `GelCamera.draw`; it takes 0.2 s."""
        return HeightRaster.of(self.heights_mm, HALF_LENGTH_MM)
