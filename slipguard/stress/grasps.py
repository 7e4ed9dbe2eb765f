"""The grasps that `slipguard stress` perturbs: what one finger's pipeline receives, and the true rotation."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from slipguard.datasets.rendered_grasps import FRAME_S, ROUND_PLAIN, RenderedGrasp, bench_object
from slipguard.sim.catalogue import find_object, object_names
from slipguard.sim.gel_camera import GelCamera
from slipguard.sim.gel_view import GelView
from slipguard.sim.sensor_unit import SensorUnit

Image = NDArray[np.uint8]
Map = NDArray[np.float32]
GRASPS = 24
STILL_FRAMES, ROTATED_FRAMES = 6, 5
STEP_DEG = 4.0


@dataclass(frozen=True, slots=True, eq=False)
class StressedGrasp:
    """The frames of one grasp and their truth.

    Attributes:
        background: (320, 240, 3) uint8 BGR without contact; None: not calibrated.
        noise_bgr: of the sensor, gray levels; None: not calibrated.
        frames: images, (320, 240, 3) uint8 BGR, captured at `times_s`.
        rotations_deg: true rotation in each frame since any of them; None: the frame shows no rotation.
        change_map: what the network's output, (160, 120) float32, is replaced with in every frame.
    """

    background: Image | None
    noise_bgr: tuple[float, float, float] | None
    px_per_mm: float
    frames: tuple[Image, ...]
    times_s: tuple[float, ...]
    rotations_deg: tuple[float | None, ...]
    change_map: Callable[[Map], Map] | None = None

    @classmethod
    def of(cls, grasp: RenderedGrasp) -> StressedGrasp:
        """Return the frames in contact of a rendered grasp."""
        shots = [shot for shot in grasp.shots if shot.contact]
        return cls(
            grasp.background,
            grasp.noise_bgr,
            grasp.px_per_mm,
            tuple(shot.frame.image for shot in shots),
            tuple(shot.frame.captured_at_s for shot in shots),
            tuple(shot.rotation_deg for shot in shots),
        )

    def with_frames(self, change: Callable[[Image], Image], first: int = 0) -> StressedGrasp:
        """Return the grasp with the frames from number `first` on changed."""
        return replace(self, frames=(*self.frames[:first], *map(change, self.frames[first:])))

    def in_order(self, order: Sequence[int], times_s: Sequence[float] | None = None) -> StressedGrasp:
        """Return the grasp with frames in another order, at these times or at 60 frames per second."""
        times = [k * FRAME_S for k in range(len(order))] if times_s is None else times_s
        frames = tuple(self.frames[index] for index in order)
        truths = tuple(self.rotations_deg[index] for index in order)
        return replace(self, frames=frames, times_s=tuple(times), rotations_deg=truths)


@cache
def rotated_grasp(number: int, *, visible: bool = True) -> StressedGrasp:
    """Return a grasp that rests, then rotates by `STEP_DEG` per frame, at a random place and depth.

    number: of the grasp; it decides on everything. visible: whether the object is one of the training objects with an
    axis, or round and without texture, so that no image shows its rotation.
    """
    rng = np.random.default_rng(np.random.SeedSequence([number, 77]))
    with_axis = [name for name in object_names("train") if find_object(name).axial]
    names = with_axis if visible else ROUND_PLAIN
    held, raster = bench_object(names[number % len(names)])
    camera = GelCamera(SensorUnit(), seed=number)
    x, y, start = rng.uniform(-2, 2), rng.uniform(-3, 3), rng.uniform(-180, 180)
    depth = held.press_mm * rng.uniform(0.5, 1.0)
    direction = float(rng.choice((-1.0, 1.0)))
    rotations = [0.0] * STILL_FRAMES + [direction * STEP_DEG * (k + 1) for k in range(ROTATED_FRAMES)]
    frames = tuple(camera.draw(GelView(held.name, x, y, start + one, depth), raster=raster) for one in rotations)
    times_s = tuple(k * FRAME_S for k in range(len(frames)))
    truths = tuple(rotations) if visible else (None,) * len(rotations)
    return StressedGrasp(camera.no_contact(), camera.unit.noise_bgr, camera.unit.px_per_mm, frames, times_s, truths)
