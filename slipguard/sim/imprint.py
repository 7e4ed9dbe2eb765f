"""The change that a pressed object causes in a unit's image.

Only the neighborhood of the imprint differs from the background image. A coarse grid, which is cheap, finds how far it
reaches; the full resolution is computed only there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import cast

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.devices import FRAME_HEIGHT_PX, FRAME_WIDTH_PX
from slipguard.errors import InputError
from slipguard.sim.gel_effects import TILT_FLOOR_MM, GelEffects
from slipguard.sim.gel_optics import STEP_PX, Shading, displaced_gel, led_visibility
from slipguard.sim.gel_view import GelView
from slipguard.sim.height_raster import FLOOR_MM, HeightRaster, height_raster_of
from slipguard.sim.raster import Field, blurred, enlarged, f32
from slipguard.sim.sensor_unit import SensorUnit
from slipguard.sim.shapes import rotated

_PAD_CELLS = 8
"""The coarse grid extends this far beyond the frame: a press outside still deforms and shades the gel inside."""
_GRID = (FRAME_WIDTH_PX // STEP_PX + 2 * _PAD_CELLS, FRAME_HEIGHT_PX // STEP_PX + 2 * _PAD_CELLS)
_RING_CELLS = 3
"""Margin of a window for the filters."""
_RING_PX = _RING_CELLS * STEP_PX
_VISIBLE_MM = 0.002
_VISIBLE_SHADE = 0.005
_GEL_BLUR_PX = 1.2
"""The gel smooths finer structure."""
_TOUCH_MM = 0.03
"""Object and gel count as touching within this distance."""
_BLUR_MIN_PX = 0.7
"""With less motion during the exposure there is no motion blur."""
_MOTION_REACH_MM = 8.0
_MOTION_LIMIT_PX = 60.0
_BISECTIONS = 9
"""Finds a depth to 0.005 mm."""


@dataclass(frozen=True, slots=True)
class Imprint:
    """The part of a frame that an object changes.

    Attributes:
        window: (rows, columns) of the frame covered by the arrays.
        change_bgr: gray levels to add.
        contact: where object and gel touch.
        gel_mm: displacement towards the camera.
    """

    window: tuple[slice, slice]
    change_bgr: Field
    contact: NDArray[np.bool_]
    gel_mm: Field


class Imprinter:
    """Computes imprints on one unit's gel."""

    def __init__(self, unit: SensorUnit, background: NDArray[np.uint8]) -> None:
        self._unit = unit
        self._shading = Shading(unit, background, _RING_PX)

    def imprint(
        self, view: GelView, exposure_s: float, raster: HeightRaster | None = None, *, whole: bool = False
    ) -> Imprint | None:
        """Return the change by an object with motion blur; None if there is none.

        Args:
            raster: a surface instead of the named object's.
            whole: compute the whole frame, for comparison.

        Raises:
            InputError: unknown object, or a pose that is not finite.
        """
        pose = (view.x_mm, view.y_mm, view.angle_deg, view.depth_mm, view.vx_mm_s, view.vy_mm_s, view.rate_deg_s)
        if not all(map(math.isfinite, pose)):
            raise InputError(f"the pose must be finite: {view}")
        if view.effects is not None:
            view.effects.check()
        if view.depth_mm <= 0.0:
            return None
        raster = _raster_of(view) if raster is None else raster
        overlap_mm = self._overlap(raster, view, STEP_PX, (-_PAD_CELLS, -_PAD_CELLS), _GRID)
        if view.effects is not None and view.effects.tilted:
            level_mm = self._overlap(raster, replace(view, effects=None), STEP_PX, (-_PAD_CELLS, -_PAD_CELLS), _GRID)
            deeper_mm = _deeper_by(level_mm, overlap_mm)
            view = replace(view, depth_mm=view.depth_mm + deeper_mm)
            overlap_mm += np.float32(deeper_mm)
        if float(overlap_mm.max()) <= 0.0:
            return None
        gel_mm = displaced_gel(overlap_mm, self._unit)
        visibility = led_visibility(gel_mm, self._unit)
        darkest = np.minimum(np.minimum(visibility[0], visibility[1]), visibility[2])
        changed = (gel_mm > _VISIBLE_MM) | (darkest < 1 - _VISIBLE_SHADE)
        if whole:
            changed[:] = True
        motion_px = self._motion_px(view, exposure_s)
        cells = _frame_cells(changed, grow=1 + math.ceil(motion_px / STEP_PX))
        return None if cells is None else self._full_size(raster, view, exposure_s, cells, gel_mm, visibility)

    def _full_size(
        self,
        raster: HeightRaster,
        view: GelView,
        exposure_s: float,
        cells: tuple[int, int, int, int],
        coarse_mm: Field,
        visibility: list[Field],
    ) -> Imprint:
        """Return the imprint on the frame pixels of some cells (left, top, right, bottom)."""
        left, top = cells[0] - _RING_CELLS, cells[1] - _RING_CELLS
        right, bottom = cells[2] + _RING_CELLS, cells[3] + _RING_CELLS
        block = (slice(top, bottom), slice(left, right))
        size = (STEP_PX * (right - left), STEP_PX * (bottom - top))
        corner = (STEP_PX * (left - _PAD_CELLS), STEP_PX * (top - _PAD_CELLS))
        overlap_mm = self._overlap(raster, view, 1, corner, size)
        membrane_mm = enlarged(coarse_mm[block], size)
        contact = (overlap_mm > 0.0) & (overlap_mm >= membrane_mm - np.float32(_TOUCH_MM))
        gel_mm = blurred(f32(np.maximum(overlap_mm, membrane_mm)), _GEL_BLUR_PX)
        x, y = corner[0] + _RING_PX, corner[1] + _RING_PX
        fields = (slice(y, y + size[1]), slice(x, x + size[0]))
        change = self._shading.change(gel_mm, [enlarged(share[block], size) for share in visibility], fields)
        change = blurred(change, self._unit.psf_px)
        if self._motion_px(view, exposure_s) > _BLUR_MIN_PX:
            change = self._motion_blur(change, view, exposure_s, corner)
        inner = (slice(_RING_PX, size[1] - _RING_PX), slice(_RING_PX, size[0] - _RING_PX))
        window = (slice(y, y + size[1] - 2 * _RING_PX), slice(x, x + size[0] - 2 * _RING_PX))
        return Imprint(window, change[inner], contact[inner], gel_mm[inner])

    def _overlap(
        self, raster: HeightRaster, view: GelView, step: int, corner: tuple[int, int], size: tuple[int, int]
    ) -> Field:
        """Return the overlap of rigid object and undeformed gel, mm, on a grid of `step` pixels from `corner`."""
        scale = self._unit.px_per_mm
        c, s = math.cos(math.radians(view.angle_deg)), math.sin(math.radians(view.angle_deg))
        first = (step - 1) / 2  # center of a cell's pixels
        right0 = (step * corner[0] + first - (FRAME_WIDTH_PX - 1) / 2) / scale
        up0 = -(step * corner[1] + first - (FRAME_HEIGHT_PX - 1) / 2) / scale
        spacing = step / scale
        dx, dy = right0 - view.x_mm, up0 - view.y_mm
        to_object = np.array(
            [[c * spacing, -s * spacing, c * dx + s * dy], [-s * spacing, -c * spacing, -s * dx + c * dy]]
        )
        if view.effects is None:
            overlap = raster.posed(to_object, size, coarse=step > 1)
        else:
            overlap = _with_effects(raster, view, view.effects, (dx, dy), spacing, size)
        overlap += np.float32(view.depth_mm)
        self._subtract_dome(overlap, view, (right0, up0), spacing)
        return overlap

    def _subtract_dome(self, overlap: Field, view: GelView, start: tuple[float, float], spacing: float) -> None:
        """Subtract the dome's sag relative to the object's origin."""
        share = self._unit.dome_share / (2.0 * self._unit.dome_radius_mm)
        if share == 0.0:
            return
        rows, columns = overlap.shape
        right = start[0] + spacing * np.arange(columns, dtype=np.float32)
        up = start[1] - spacing * np.arange(rows, dtype=np.float32)
        overlap -= np.float32(share) * right * right
        share_up = share / self._unit.dome_aspect**2
        origin_mm = share * (view.x_mm**2 + view.y_mm**2 / self._unit.dome_aspect**2)
        overlap -= (np.float32(share_up) * up * up - np.float32(origin_mm))[:, None]

    def _motion_px(self, view: GelView, exposure_s: float) -> float:
        """Return the largest motion of a point of the imprint during the exposure, pixels."""
        rotating_mm_s = math.radians(abs(view.rate_deg_s)) * _MOTION_REACH_MM
        speed_mm_s = math.hypot(view.vx_mm_s, view.vy_mm_s) + rotating_mm_s
        return min(speed_mm_s * exposure_s * self._unit.px_per_mm, _MOTION_LIMIT_PX)

    def _motion_blur(self, change: Field, view: GelView, exposure_s: float, corner: tuple[int, int]) -> Field:
        """Average over the poses of the exposure: each pass adds the image to its shifted self, doubling the poses."""
        scale = self._unit.px_per_mm
        origin = (
            view.x_mm * scale + (FRAME_WIDTH_PX - 1) / 2 - corner[0],
            -view.y_mm * scale + (FRAME_HEIGHT_PX - 1) / 2 - corner[1],
        )
        size = (change.shape[1], change.shape[0])

        def moved(image: Field, share: float) -> Field:
            rotation = cv2.getRotationMatrix2D(origin, view.rate_deg_s * exposure_s * share, 1.0)
            rotation[0, 2] += view.vx_mm_s * exposure_s * scale * share
            rotation[1, 2] -= view.vy_mm_s * exposure_s * scale * share
            return cast("Field", cv2.warpAffine(image, rotation, size, flags=cv2.INTER_LINEAR))

        passes = max(math.ceil(math.log2(self._motion_px(view, exposure_s))), 1)  # copies about a pixel apart
        for k in range(passes):
            share = 0.5 ** (k + 1)
            change = f32(cv2.addWeighted(moved(change, share / 2), 0.5, moved(change, -share / 2), 0.5, 0.0))
        return change


def _deeper_by(level_mm: Field, tilted_mm: Field) -> float:
    """Return by how much a tilted object is pressed deeper (< 0: less deep) at the same force, at most to the floor.

    The gel is taken as a bed of springs: the force is the sum of the overlaps.
    """
    force = float(np.maximum(level_mm, 0.0).sum())
    top_mm = float(tilted_mm.max())
    low, high = -top_mm, -FLOOR_MM - top_mm
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        if float(np.maximum(tilted_mm + np.float32(middle), 0.0).sum()) < force:
            low = middle
        else:
            high = middle
    return 0.5 * (low + high)


def _raster_of(view: GelView) -> HeightRaster:
    if view.effects is None or not view.effects.tilted:
        return height_raster_of(view.object_name)
    return height_raster_of(view.object_name, TILT_FLOOR_MM)


def _with_effects(
    raster: HeightRaster,
    view: GelView,
    effects: GelEffects,
    corner_mm: tuple[float, float],
    spacing_mm: float,
    size: tuple[int, int],
) -> Field:
    """Return the heights of an object with its effects on a grid. corner_mm: from the object's origin, right and up."""
    right = np.float32(corner_mm[0]) + np.float32(spacing_mm) * np.arange(size[0], dtype=np.float32)
    up = np.float32(corner_mm[1]) - np.float32(spacing_mm) * np.arange(size[1], dtype=np.float32)
    x, y = np.meshgrid(right, up)
    if effects.deformed:
        x, y = effects.undeformed(f32(x), f32(y))
    u, v = rotated(f32(x), f32(y), view.angle_deg)
    heights = raster.sampled(u, v, coarse=spacing_mm > 2.0 / raster.px_per_mm)
    if effects.tilted:
        heights += np.float32(math.tan(math.radians(effects.pitch_deg))) * u
        heights += np.float32(math.tan(math.radians(effects.roll_deg))) * v
    return heights


def _frame_cells(changed: NDArray[np.bool_], grow: int) -> tuple[int, int, int, int] | None:
    """Return the bounds (left, top, right, bottom) of the changed cells in the frame, enlarged by `grow`, or None."""
    left, top, width, height = cv2.boundingRect(changed.astype(np.uint8))
    if width == 0:
        return None
    rows, columns = changed.shape
    left, top = max(left - grow, _PAD_CELLS), max(top - grow, _PAD_CELLS)
    right = min(left + width + 2 * grow, columns - _PAD_CELLS)
    bottom = min(top + height + 2 * grow, rows - _PAD_CELLS)
    return (left, top, right, bottom) if right > left and bottom > top else None
