"""Rendered grasps of known rotation: no contact, closing, still, rotating to and fro while force and position change.

Faster than the whole simulated cell and identical for every pipeline: the data of `slipguard bench`. It has
the test objects and two plain round ones, whose rotation is not observable.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from slipguard.devices import Frame
from slipguard.sim import shapes
from slipguard.sim.catalogue import find_object
from slipguard.sim.contact_label import label
from slipguard.sim.gel_camera import GelCamera
from slipguard.sim.gel_view import GelView
from slipguard.sim.height_raster import HeightRaster
from slipguard.sim.sensor_unit import LightChange, SensorUnit, random_unit
from slipguard.sim.sim_object import HeightMap, SimObject

FRAME_S = 1.0 / 60.0
EMPTY_FRAMES, CLOSING_FRAMES, STILL_FRAMES, SHEAR_FRAMES, END_FRAMES = 6, 6, 10, 8, 8
ROTATION_DEG = (10.0, 30.0)
"""Rotation to one side, then past the start to the other side."""
RATE_DEG_S = (40.0, 300.0)
"""Peak rotation rate: from slow slip to a fall."""
POSITION_MM = (2.2, 3.5)
"""Maximum distance of the contact from the image center, right and up: the frame cuts off large contacts."""
SHIFT_MM = 1.2
SHEAR_MM = (0.2, 0.6)
"""Translation of the patch between the rotations."""
GROWTH = (1.0, 1.7)
FORCE_CHANGE = (0.85, 1.15)
"""Factors on the press depth: after the first rotation, and after the second."""

ROUND_TEXTURED = ("cap", "ball")
ROUND_PLAIN = ("ring", "plain_disc", "plain_ball")
EXTRA_PLAIN = ("plain_disc", "plain_ball")


@dataclass(frozen=True, slots=True, eq=False)
class GraspFrame:
    """One frame and its truth.

    Attributes:
        rotation_deg: since the object was held still.
        compared: whether it counts for the rotation error (after the reference, in contact).
        mask: (320, 240) uint8, the contact label; None if not requested.
        shift_mm: shift since then of the object's point at the image center, right and up; None where not compared.
    """

    frame: Frame
    contact: bool
    rotation_deg: float
    compared: bool
    mask: NDArray[np.uint8] | None
    shift_mm: tuple[float, float] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class RenderedGrasp:
    """One grasp of one object by one sensor unit.

    Attributes:
        background: the unit's background image.
        noise_bgr: as calibrated.
        peak_deg_s: peak rotation rate.
        growth: ratio of largest to smallest press depth during the rotation.
    """

    object_name: str
    readable: bool
    background: NDArray[np.uint8]
    noise_bgr: tuple[float, float, float]
    px_per_mm: float
    shots: tuple[GraspFrame, ...]
    peak_deg_s: float = 0.0
    growth: float = 1.0


@dataclass(frozen=True, slots=True)
class _Segment:
    """The end of one segment of the motion: a smooth step in rotation and position, linear in depth."""

    frames: int
    rotation_deg: float
    x_mm: float
    y_mm: float
    depth_mm: float


def render_grasp(object_name: str, seed: int, with_masks: bool = False, mask_every: int = 1) -> RenderedGrasp:
    """Return one rendered grasp, deterministic for name and seed. Raises InputError for an unknown object.

    Args:
        with_masks: label every `mask_every`-th frame.
    """
    rng = np.random.default_rng(np.random.SeedSequence([seed, *object_name.encode()]))
    item, raster = bench_object(object_name)
    unit = SensorUnit() if seed % 2 == 0 else random_unit(rng)
    camera = GelCamera(unit, seed=int(rng.integers(2**31)))
    background = camera.no_contact()
    camera.set_light(LightChange(1.0, tuple(rng.uniform(-5.0, 5.0, 3)), tuple(rng.uniform(-1.5, 1.5, 3))))
    shots = []
    peak_deg_s, depths_mm = 0.0, []
    for index, (view, rotation, compared) in enumerate(_views(item, rng)):
        mask = None
        if with_masks and index % mask_every == 0:
            truth = camera.draw_with_truth(view, raster=raster)
            image, mask = truth.image, label(truth)
        else:
            image = camera.draw(view, raster=raster)
        shots.append(GraspFrame(Frame(image, index * FRAME_S, index), view.depth_mm > 0.0, rotation, compared, mask))
        peak_deg_s = max(peak_deg_s, abs(view.rate_deg_s))
        depths_mm += [view.depth_mm] * compared
    return RenderedGrasp(
        object_name,
        item.axial,
        background,
        unit.noise_bgr,
        unit.px_per_mm,
        tuple(shots),
        peak_deg_s,
        max(depths_mm) / min(depths_mm),
    )


@cache
def bench_object(name: str) -> tuple[SimObject, HeightRaster | None]:
    """Return a catalogue object, or a plain round one with its raster. Raises InputError for another name."""
    surfaces: dict[str, tuple[HeightMap, float]] = {
        "plain_disc": (lambda u, v: shapes.plateau(shapes.disc(u, v, 4.0), 0.7), 0.8),
        "plain_ball": (lambda u, v: shapes.sphere(u, v, 6.0), 1.2),
    }
    if name not in surfaces:
        return find_object(name), None
    height_mm, press_mm = surfaces[name]
    return SimObject(name, "test", height_mm, 0.5, 100.0, 0.003, 0.7, press_mm, axial=False), HeightRaster.of(height_mm)


def _views(item: SimObject, rng: np.random.Generator) -> Iterator[tuple[GelView, float, bool]]:
    """Yield pose, rotation and whether the frame is compared."""
    start_deg = float(rng.uniform(-180.0, 180.0))
    x, y = float(rng.uniform(-1, 1) * POSITION_MM[0]), float(rng.uniform(-1, 1) * POSITION_MM[1])
    press = item.press_mm * float(rng.uniform(0.45, 0.75))
    name = item.name
    for _ in range(EMPTY_FRAMES):
        yield GelView(name), 0.0, False
    for k in range(1, CLOSING_FRAMES + 1):
        yield GelView(name, x, y, start_deg, press * k / CLOSING_FRAMES), 0.0, False
    for _ in range(STILL_FRAMES):
        yield GelView(name, x, y, start_deg, press), 0.0, False
    before = _Segment(0, 0.0, x, y, press)
    for segment in _segments(before, rng, 1.1 * item.press_mm):
        duration_s = segment.frames * FRAME_S
        way = segment.rotation_deg - before.rotation_deg
        for k in range(1, segment.frames + 1):
            part = k / segment.frames
            done = part * part * (3.0 - 2.0 * part)
            rotation = before.rotation_deg + done * way
            yield (
                GelView(
                    name,
                    before.x_mm + done * (segment.x_mm - before.x_mm),
                    before.y_mm + done * (segment.y_mm - before.y_mm),
                    start_deg + rotation,
                    before.depth_mm + part * (segment.depth_mm - before.depth_mm),
                    rate_deg_s=way * 6.0 * part * (1.0 - part) / duration_s,
                ),
                rotation,
                True,
            )
        before = segment
    yield GelView(name), 0.0, False


def _segments(start: _Segment, rng: np.random.Generator, deepest_mm: float) -> list[_Segment]:
    side = float(rng.choice([-1.0, 1.0]))
    out_deg, back_deg = side * float(rng.uniform(*ROTATION_DEG)), -side * float(rng.uniform(*ROTATION_DEG))
    low, high = math.log(RATE_DEG_S[0]), math.log(RATE_DEG_S[1])
    peak_deg_s = math.exp(rng.uniform(low, high))
    grown_mm = min(start.depth_mm * float(rng.uniform(*GROWTH)), deepest_mm)
    last_mm = min(grown_mm * float(rng.uniform(*FORCE_CHANGE)), deepest_mm)

    def shifted(segment: _Segment, by_mm: float) -> tuple[float, float]:
        direction = float(rng.uniform(-math.pi, math.pi))
        return segment.x_mm + by_mm * math.cos(direction), segment.y_mm + by_mm * math.sin(direction)

    def frames(way_deg: float) -> int:
        return max(math.ceil(1.5 * abs(way_deg) / peak_deg_s / FRAME_S), 4)  # a smooth step's peak: 1.5 times its mean

    out = _Segment(frames(out_deg), out_deg, *shifted(start, SHIFT_MM * float(rng.uniform(0, 1))), grown_mm)
    sheared = _Segment(SHEAR_FRAMES, out_deg, *shifted(out, float(rng.uniform(*SHEAR_MM))), grown_mm)
    back = _Segment(frames(back_deg - out_deg), back_deg, *shifted(sheared, 0.5 * float(rng.uniform(0, 1))), last_mm)
    return [out, sheared, back, _Segment(END_FRAMES, back.rotation_deg, back.x_mm, back.y_mm, back.depth_mm)]
