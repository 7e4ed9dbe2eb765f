"""Randomized rendered frames for training and validation of networks.

The ranges cover the known variation of real units and more; a frame depends on its seed only.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.datasets.random_shapes import broad, composition, resized, roughened, with_neighbor
from slipguard.sim.catalogue import object_names
from slipguard.sim.contact_label import VISIBLE_MM
from slipguard.sim.gel_camera import GelCamera, GelTruth
from slipguard.sim.gel_view import GelView
from slipguard.sim.height_raster import HeightRaster, height_raster_of
from slipguard.sim.raster import blurred
from slipguard.sim.sensor_unit import LightChange, random_unit

Image = NDArray[np.uint8]
UNIT_FRAMES = 50
"""Number of consecutive seeds that share a sensor unit; creating one takes as long as several frames."""
NO_CONTACT_SHARE = 0.15
COMPOSITION_SHARE = 0.4
COMPOSITION_NAME = "composition"
BROAD_SHARE = 0.2
BROAD_NAME = "broad"
DEPTH_MM = {BROAD_NAME: (0.25, 2.0)}
"""Lightest and deepest press; a broad body is pressed deeper before it fills the image."""
USUAL_DEPTH_MM = (0.12, 1.5)
EXPOSURE_S = (0.004, 0.016)


@dataclass(frozen=True, slots=True, eq=False)
class RenderedSample:
    """One frame.

    Attributes:
        image, background: (320, 240, 3) uint8 BGR, the frame and the unit's background image.
        truth: its image is the frame before contrast, compression and wear.
        has_contact: whether there is a visible contact.
    """

    image: Image
    background: Image
    truth: GelTruth
    view: GelView
    has_contact: bool


def unit_blocks(first_seed: int, count: int) -> list[range]:
    """Return `count` seeds from `first_seed` on, in blocks that share a sensor unit."""
    seeds = range(first_seed, first_seed + count)
    edges = [first_seed, *(seed for seed in seeds[1:] if seed % UNIT_FRAMES == 0), first_seed + count]
    return [range(*edge) for edge in pairwise(edges)]


def render_samples(
    seeds: range, backgrounds: Sequence[Image] | None = None, split: str = "train"
) -> Iterator[RenderedSample]:
    """Yield the frames of seeds (>= 0). About 15 % show no contact.

    Args:
        backgrounds: real background images, (320, 240, 3) uint8, used for half of the units.
        split: "test" for the test objects; "train" for training objects, random compositions and broad bodies.
    """
    for block in unit_blocks(seeds.start, len(seeds)):
        camera = _camera(block, backgrounds)
        for seed in block:
            rng = np.random.default_rng([seed, 1 if split == "test" else 0])
            camera.reseed(int(rng.integers(2**31)))
            camera.set_light(_light(rng))
            name, raster = _surface(rng, split)
            view = _view(rng, name)
            truth = camera.draw_with_truth(view, float(rng.uniform(*EXPOSURE_S)), raster)
            background = camera.no_contact()
            if rng.random() < 0.5:
                background = _shifted(background, rng)
            yield _finished(rng, truth, background, view)


def render_presses(names: Sequence[str], seeds: range) -> Iterator[RenderedSample]:
    """Yield the frames of seeds (>= 0) that show the given training objects in turn, always with visible contact.

    Sizes, textures, poses, light and wear vary as in `render_samples`. Raises InputError for an unknown object.
    """
    for block in unit_blocks(seeds.start, len(seeds)):
        camera = _camera(block, None)
        for seed in block:
            rng = np.random.default_rng([seed, 2])
            camera.reseed(int(rng.integers(2**31)))
            camera.set_light(_light(rng))
            name = names[seed % len(names)]
            raster = _sometimes_rough(_any_size(height_raster_of(name), rng), rng)
            while True:
                view = _press(rng, name)
                truth = camera.draw_with_truth(view, float(rng.uniform(*EXPOSURE_S)), raster)
                if truth.displacement_mm.max() > VISIBLE_MM:
                    break
            yield _finished(rng, truth, camera.no_contact(), view)


def _camera(block: range, backgrounds: Sequence[Image] | None) -> GelCamera:
    number = block.start // UNIT_FRAMES
    return GelCamera(random_unit(np.random.default_rng([number, 240, 320]), backgrounds), seed=number)


def _any_size(raster: HeightRaster, rng: np.random.Generator) -> HeightRaster:
    return resized(raster, float(rng.uniform(0.75, 1.3)))


def _sometimes_rough(raster: HeightRaster, rng: np.random.Generator) -> HeightRaster:
    return roughened(raster, rng, float(rng.uniform(0.010, 0.080))) if rng.random() < 0.5 else raster


def _light(rng: np.random.Generator) -> LightChange:
    """Return a random change of the light against the background image: up to 6 gray levels, uneven."""
    if rng.random() < 0.2:
        return LightChange()
    offset = np.clip(rng.uniform(-4.0, 4.0) + rng.normal(0.0, 2.0, 3), -6.0, 6.0)
    right, up = rng.normal(0, 1.5, 3), rng.normal(0, 1.5, 3)
    return LightChange(float(rng.uniform(0.95, 1.05)), _bgr(offset), _bgr(right), _bgr(up))


def _bgr(values: NDArray[np.float64]) -> tuple[float, float, float]:
    return float(values[0]), float(values[1]), float(values[2])


def _surface(rng: np.random.Generator, split: str) -> tuple[str, HeightRaster]:
    if split == "train" and rng.random() < BROAD_SHARE:
        return BROAD_NAME, _sometimes_rough(broad(rng), rng)
    names = object_names(split)
    name = names[int(rng.integers(len(names)))]
    composed = split == "train" and rng.random() < COMPOSITION_SHARE
    raster = composition(rng) if composed else height_raster_of(name)
    if split == "train":
        raster = _any_size(raster, rng)
        if rng.random() < 0.12:
            raster = with_neighbor(raster, height_raster_of(names[int(rng.integers(len(names)))]), rng)
    return (COMPOSITION_NAME if composed else name), _sometimes_rough(raster, rng)


def _view(rng: np.random.Generator, name: str) -> GelView:
    """Return no contact, or a pose: a quarter near or across the border, a third moving."""
    if rng.random() < NO_CONTACT_SHARE:
        return GelView(object_name="", depth_mm=-1.0)
    return _press(rng, name)


def _press(rng: np.random.Generator, name: str) -> GelView:
    reach_x_mm, reach_y_mm = (6.5, 9.0) if rng.random() < 0.25 else (3.5, 5.0)
    rate_deg_s = vx_mm_s = vy_mm_s = 0.0
    if rng.random() < 0.33:
        rate_deg_s = float(rng.choice((-1, 1)) * rng.uniform(20.0, 300.0))
        vx_mm_s, vy_mm_s = float(rng.normal(0.0, 8.0)), float(rng.normal(0.0, 15.0))
    return GelView(
        object_name=name,
        x_mm=float(rng.uniform(-reach_x_mm, reach_x_mm)),
        y_mm=float(rng.uniform(-reach_y_mm, reach_y_mm)),
        angle_deg=float(rng.uniform(-180.0, 180.0)),
        depth_mm=math.exp(float(rng.uniform(*np.log(DEPTH_MM.get(name, USUAL_DEPTH_MM))))),
        vx_mm_s=vx_mm_s,
        vy_mm_s=vy_mm_s,
        rate_deg_s=rate_deg_s,
    )


def _finished(rng: np.random.Generator, truth: GelTruth, background: Image, view: GelView) -> RenderedSample:
    image = truth.image
    if rng.random() < 0.25:
        image, background = _worn(rng, image, background)
    if rng.random() < 0.4:
        contrast, brightness = float(rng.uniform(0.75, 1.2)), float(rng.uniform(-12.0, 12.0))
        image, background = (
            np.asarray(cv2.convertScaleAbs(np.maximum(one, 14), alpha=contrast, beta=brightness), np.uint8)
            for one in (image, background)
        )
    if rng.random() < 0.3:
        quality = int(rng.integers(60, 96))
        image = _compressed(image, quality)
        if rng.random() < 0.5:
            background = _compressed(background, quality)
    return RenderedSample(image, background, truth, view, float(truth.displacement_mm.max()) > VISIBLE_MM)


def _shifted(image: Image, rng: np.random.Generator) -> Image:
    """Return the image moved by up to a pixel: the camera is mounted in soft plastic."""
    dx, dy = rng.uniform(-0.7, 0.7, 2)
    matrix = np.array([[1.0, 0.0, dx], [0.0, 1.0, dy]])
    moved = cv2.warpAffine(image, matrix, (image.shape[1], image.shape[0]), borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(moved, np.uint8)


def _worn(rng: np.random.Generator, image: Image, background: Image) -> tuple[Image, Image]:
    """Return both images with scratches and specks; most are in the background image too, some are new."""
    rows, columns = image.shape[:2]
    old = np.zeros(image.shape, np.float32)
    new = np.zeros(image.shape, np.float32)
    for _ in range(int(rng.integers(1, 5))):
        sheet = new if rng.random() < 0.25 else old
        start = np.array([rng.uniform(0, columns), rng.uniform(0, rows)])
        end = start + rng.normal(0.0, 1.0, 2) * (rng.uniform(5, 120) if sheet is old else rng.uniform(1, 12))
        level = rng.normal(0.0, 18.0) + rng.normal(0.0, 8.0, 3)
        from_px, to_px = np.rint(start).astype(int).tolist(), np.rint(end).astype(int).tolist()
        cv2.line(sheet, from_px, to_px, _bgr(level), int(rng.integers(1, 3)), cv2.LINE_AA)
    old, new = blurred(old, 0.8), blurred(new, 0.8)
    worn = cv2.add(image, old + new, dtype=cv2.CV_8U), cv2.add(background, old, dtype=cv2.CV_8U)
    return np.asarray(worn[0], np.uint8), np.asarray(worn[1], np.uint8)


def _compressed(image: Image, quality: int) -> Image:
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8)
