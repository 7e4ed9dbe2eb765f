"""One finger that holds an object: `see` draws the next frame and returns the pipeline's estimate.

`DrawnFinger` draws surfaces under three lights and gives the network's answer itself: fast, and exact in angle.
`RenderedFinger` uses the simulator's gel camera and the shipped network.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from textured_surfaces import LedLights, Surface, contact_map, heights, shaded_image

from slipguard.datasets.rendered_grasps import bench_object
from slipguard.devices import Frame
from slipguard.perception.estimate import Estimate
from slipguard.perception.pipeline import Pipeline
from slipguard.perception.segmenter import Segmenter
from slipguard.perception.settings import PerceptionSettings
from slipguard.perception.skipping import ALL_SKIPS, Skips
from slipguard.perception.stored_reference import ResumingPipeline
from slipguard.sim.gel_camera import GelCamera
from slipguard.sim.gel_view import GelView
from slipguard.sim.height_raster import HeightRaster
from slipguard.sim.sensor_unit import random_unit

FRAME_S = 1.0 / 60.0
BACKGROUND = np.full((320, 240, 3), 100, np.uint8)
NOISE = 2.0
CENTER = (120.0, 160.0)
PX_PER_MM = 18.5
START_DEG = 15.0
"""How a drawn surface lies in the image at rotation 0."""


class CountedSegmenter(Segmenter):
    """The shipped network; counts its runs."""

    calls = 0

    def segment(self, image: NDArray[np.uint8], background: NDArray[np.uint8] | None) -> NDArray[np.float32]:
        self.calls += 1
        return super().segment(image, background)


class DrawnContact:
    """A network that returns the map it is given, (160, 120) float32; counts its runs."""

    threshold = 0.5
    input_size = (120, 160)

    def __init__(self) -> None:
        self.map: NDArray[np.float32] = np.zeros((160, 120), np.float32)
        self.calls = 0

    def segment(self, image: NDArray[np.uint8], background: NDArray[np.uint8] | None) -> NDArray[np.float32]:
        self.calls += 1
        return self.map


class DrawnFinger:
    """A finger in front of a drawn surface.

    Args:
        surface: The object; None for none.
        background: The background image, or None.
        settings: Keys of `PerceptionSettings`.
    """

    def __init__(
        self,
        surface: Surface | None,
        background: NDArray[np.uint8] | None = BACKGROUND,
        mounting_deg: int = 0,
        skips: Skips = ALL_SKIPS,
        lights: LedLights = LedLights(),  # noqa: B008 frozen
        **settings: Any,
    ) -> None:
        self.network = DrawnContact()
        self.pipeline = Pipeline(
            self.network,
            PerceptionSettings(**settings),
            background,
            (NOISE, NOISE, NOISE),
            PX_PER_MM,
            mounting_deg,
            skips=skips,
        )
        self.resuming = ResumingPipeline(self.pipeline)
        self.surface, self.lights = surface, lights
        self.frames, self.now_s = 0, 0.0

    def draw(self, rotation_deg: float, at: tuple[float, float] = CENTER, force: float = 1.0) -> Frame:
        """Return the next frame of the surface, and prepare the network's answer to it."""
        self.frames += 1
        rng = np.random.default_rng(self.frames)
        if self.surface is None:
            self.network.map = np.zeros((160, 120), np.float32)
            image = np.clip(np.rint(100.0 + NOISE * rng.standard_normal(BACKGROUND.shape)), 0, 255).astype(np.uint8)
        else:
            height = heights(self.surface, START_DEG + rotation_deg, at, force)
            self.network.map = contact_map(height)
            image = shaded_image(height, self.lights, NOISE, rng)
        return Frame(image, self.now_s, self.frames)

    def see(
        self, rotation_deg: float, after_s: float = FRAME_S, at: tuple[float, float] = CENTER, force: float = 1.0
    ) -> Estimate:
        self.now_s += after_s
        return self.resuming.process(self.draw(rotation_deg, at, force))

    def rest(self, frames: int = 6, rotation_deg: float = 0.0) -> Estimate:
        """See the object at rest; after six frames there is a reference. Return the last estimate."""
        return [self.see(rotation_deg) for _ in range(frames)][-1]


class RenderedFinger:
    """A finger of a random sensor unit that holds an object of the simulator.

    Args:
        name: The object.
        seed: Of the unit, its noise, and the object's pose.
        raster: The object's surface, if it is not one of the catalogue.
        depth: Depth of the press as a share of the object's usual one; with a raster, in millimeters.
        angle_deg: How the object lies; None: at random.
    """

    def __init__(
        self,
        name: str,
        seed: int,
        raster: HeightRaster | None = None,
        depth: float = 0.6,
        angle_deg: float | None = None,
        skips: Skips = ALL_SKIPS,
        with_background: bool = True,
        **settings: Any,
    ) -> None:
        rng = np.random.default_rng(seed)
        unit = random_unit(rng)
        self._camera, self._raster = GelCamera(unit, seed=seed), raster
        depth_mm = depth if raster is not None else depth * bench_object(name)[0].press_mm
        x_mm, y_mm, start_deg = rng.uniform(-1, 1), rng.uniform(-1, 1), rng.uniform(-180, 180)
        self.view = GelView(name, x_mm, y_mm, start_deg if angle_deg is None else angle_deg, depth_mm)
        self.network = CountedSegmenter()
        background = self._camera.no_contact() if with_background else None
        self.pipeline = Pipeline(
            self.network, PerceptionSettings(**settings), background, unit.noise_bgr, unit.px_per_mm, skips=skips
        )
        self.frames, self.now_s = 0, 0.0

    def draw(
        self,
        rotation_deg: float,
        after_s: float = FRAME_S,
        slid_mm: float = 0.0,
        mm_s: float = 0.0,
        deeper: float = 1.0,
    ) -> Frame:
        """Return the next frame: the object rotated, slid down and pressed deeper since the start."""
        start = self.view
        view = replace(
            start,
            y_mm=start.y_mm - slid_mm,
            angle_deg=start.angle_deg + rotation_deg,
            depth_mm=start.depth_mm * deeper,
            vy_mm_s=-mm_s,
        )
        self.frames, self.now_s = self.frames + 1, self.now_s + after_s
        return Frame(self._camera.draw(view, raster=self._raster), self.now_s, self.frames)

    def see(
        self,
        rotation_deg: float,
        after_s: float = FRAME_S,
        slid_mm: float = 0.0,
        mm_s: float = 0.0,
        deeper: float = 1.0,
    ) -> Estimate:
        return self.pipeline.process(self.draw(rotation_deg, after_s, slid_mm, mm_s, deeper))

    def rest(self, frames: int = 8, rotation_deg: float = 0.0) -> Estimate:
        """See the object at rest; then there is a reference. Return the last estimate."""
        return [self.see(rotation_deg) for _ in range(frames)][-1]
