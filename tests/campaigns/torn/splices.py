"""Pairs of captures, rendered and real, and frames spliced from them at every line."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.perception.torn_frame import find_tear
from slipguard.sim import shapes
from slipguard.sim.camera_noise import CameraNoise
from slipguard.sim.catalogue import object_names
from slipguard.sim.gel_camera import GelCamera
from slipguard.sim.gel_view import GelView
from slipguard.sim.height_raster import HeightRaster
from slipguard.sim.sensor_unit import NOISE_STD_BGR, STRIPE_STD_BGR, SensorUnit, random_unit
from slipguard.tools.image_files import read_bgr
from tests.campaigns.rotated_presses import press_images, rotated_difference

Image = NDArray[np.uint8]
ALONG = ("column", "row")
FRAME_S = 1.0 / 60.0
STEPS_DEG = {"still": 0.0, "60°/s": 1.0, "300°/s": 5.0, "1500°/s": 25.0}
"""Rotation from one capture to the next."""
EDGES_LEVELS = (0.0, 1.0, 2.0, 3.0, 4.0, 6.0, 10.0, 1e3)
"""Classes of the difference between the captures at the line, gray levels."""
SMOOTH = ("knife_edge", "ring", "hook")
"""Test objects without texture; of the real presses, the balls are smooth and the indenter has edges."""
_BLUR_PX = 9

_BOXES = {
    "box": lambda u, v: shapes.plateau(shapes.box(u, v, 14.0, 2.5), 0.02),
    "thin box": lambda u, v: shapes.plateau(shapes.box(u, v, 14.0, 0.5), 0.02),
    "edge of a box": lambda u, v: shapes.plateau(shapes.box(u, v - np.float32(10.0), 14.0, 10.0), 0.02),
}


@dataclass(frozen=True, slots=True, eq=False)
class Captures:
    """The frame before, and the two captures of a torn frame. kind: where they are from and how much moves."""

    kind: str
    previous: Image
    first: Image
    second: Image


@dataclass(frozen=True, slots=True)
class SpliceResult:
    """One torn frame.

    Attributes:
        line: the first one of the second capture, as a share of all lines.
        levels: rms difference between its captures at the line, without that of the light.
    """

    kind: str
    along: str
    line: float
    levels: float
    found: bool
    at_line: bool


def rendered_captures(units: int, seed: int = 0) -> Iterator[Captures]:
    """Yield captures of the test objects on random units, at each speed of rotation."""
    rng = np.random.default_rng(seed)
    for number in range(units):
        camera = GelCamera(random_unit(rng) if number else SensorUnit(), seed=seed + number)
        for name in object_names("test"):
            x_mm, y_mm, angle_deg, depth_mm = rng.uniform((-1.5, -1.5, 0.0, 0.3), (1.5, 1.5, 180.0, 0.9)).tolist()
            start = GelView(name, x_mm, y_mm, angle_deg, depth_mm)
            for speed, step_deg in STEPS_DEG.items():
                rate = step_deg / FRAME_S
                poses = [replace(start, angle_deg=start.angle_deg + k * step_deg, rate_deg_s=rate) for k in (0, 0, 1)]
                surface = "smooth" if name in SMOOTH else "textured"
                yield Captures(f"rendered, {surface}, {speed}", *(camera.draw(pose) for pose in poses))


def rendered_good_pairs(units: int, seed: int = 0) -> Iterator[tuple[str, Image, Image]]:
    """Yield (kind, frame before, frame) without tears: objects, and boxes whose straight edges lie along the lines."""
    rng = np.random.default_rng(seed)
    boxes = {name: HeightRaster.of(height) for name, height in _BOXES.items()}
    for number in range(units):
        unit = random_unit(rng) if number else SensorUnit()
        camera = GelCamera(replace(unit, psf_px=0.8) if number % 3 == 1 else unit, seed=seed + number)
        empty = camera.draw(GelView(""))
        for name in (*boxes, *object_names("test")):
            angle = float(rng.choice([0.0, 90.0])) if name in boxes else float(rng.uniform(0, 180))
            x_mm, y_mm, depth_mm = rng.uniform((-3.0, -3.0, 0.2), (3.0, 3.0, 1.2)).tolist()
            pose = GelView(name, x_mm, y_mm, angle, depth_mm)
            shift_mm, turn_deg = rng.choice([0.0, 0.1, 1.0, 5.0], 2) * rng.choice([-1, 1], 2), rng.choice([0, 0, 2, 20])
            moved = replace(
                pose,
                x_mm=pose.x_mm + float(shift_mm[0]),
                y_mm=pose.y_mm + float(shift_mm[1]),
                angle_deg=pose.angle_deg + float(turn_deg),
            )
            raster = boxes.get(name)
            here, there = camera.draw(pose, raster=raster), camera.draw(moved, raster=raster)
            kind = "boxes along the lines" if name in boxes else "rendered objects"
            yield from ((kind, empty, here), (kind, here, there), (kind, there, empty))


def real_images(folder: Path) -> dict[str, list[Image]]:
    """Return the real frames of each unit in the folder of real DIGIT frames."""
    parts = {
        "indenter": [*sorted((folder / "anytouch2_force2" / "frames").glob("*.png"))],
        "balls": [*sorted((folder / "taxim_sphere").glob("*.png"))],
        "untouched": [*sorted((folder / "backgrounds").glob("*.png")), folder / "aurova" / "frame.png"],
    }
    parts["indenter"].append(folder / "anytouch2_force2" / "background.png")
    return {name: [read_bgr(path) for path in paths] for name, paths in parts.items()}


def real_captures(folder: Path, pairs: int, seed: int = 0) -> Iterator[Captures]:
    """Yield captures of real frames: neighboring ones of the video, and any two of one unit."""
    rng = np.random.default_rng(seed)
    noise = CameraNoise(NOISE_STD_BGR, STRIPE_STD_BGR, seed)
    images = real_images(folder)

    def captures(kind: str, first: Image, second: Image) -> Captures:
        previous = np.clip(np.rint(first + noise.next()), 0, 255).astype(np.uint8)
        return Captures(kind, previous, first, second)

    for first, second in zip(images["indenter"][:-2], images["indenter"][1:-1], strict=True):
        yield captures("real, 4 frames apart", first, second)
    for name in ("indenter", "balls"):
        for _ in range(pairs):
            one, other = rng.choice(len(images[name]), 2, replace=False)
            yield captures("real, any two", images[name][one], images[name][other])


def rotated_real_captures(folder: Path, presses: int, seed: int = 0) -> Iterator[Captures]:
    """Yield captures of real presses that rotate, relit, at each speed of rotation."""
    rng = np.random.default_rng(seed)
    noise = CameraNoise(NOISE_STD_BGR, STRIPE_STD_BGR, seed)
    every = list(press_images(folder))
    for number in rng.choice(len(every), min(presses, len(every)), replace=False):
        press, start_deg = every[number], float(rng.uniform(0.0, 180.0))
        surface = "edges" if press.readable else "smooth"
        for speed, step_deg in STEPS_DEG.items():
            angles = (start_deg, start_deg, start_deg + step_deg)
            images = [press.background + rotated_difference(press, angle, "relit") + noise.next() for angle in angles]
            rounded = (np.clip(np.rint(image), 0, 255).astype(np.uint8) for image in images)
            yield Captures(f"real, rotated, {surface}, {speed}", *rounded)


def real_good_pairs(folder: Path) -> Iterator[tuple[str, Image, Image]]:
    """Yield every ordered pair of frames of one unit: none of them is torn after any of the others."""
    for name, images in real_images(folder).items():
        for number, image in enumerate(images):
            for other, before in enumerate(images):
                if number != other:
                    yield f"real, {name}", before, image


def half_size(image: Image) -> Image:
    """Return the image at 120 x 160."""
    return np.asarray(cv2.resize(image, (120, 160), interpolation=cv2.INTER_AREA), np.uint8)


def spliced(first: Image, second: Image, along: str, line: int) -> Image:
    """Return an image with the lines before `line` from the first one. along: "row" or "column"."""
    image = second.copy()
    part = (slice(0, line),) if along == "row" else (slice(None), slice(0, line))
    image[part] = first[part]
    return image


def splice_results(captures: Captures, every: int = 1) -> Iterator[SpliceResult]:
    """Splice at every (`every`-th) row and column, and look for the tear."""
    height, width, _ = captures.first.shape
    for along, count in (("row", height), ("column", width)):
        levels = _difference_levels(captures, along)
        for line in range(1 + (count + every) // 2 % every, count, every):
            tear = find_tear(spliced(captures.first, captures.second, along, line), captures.previous)
            at_line = tear == f"{along} {line}"
            yield SpliceResult(captures.kind, along, line / count, float(levels[line]), tear is not None, at_line)


def _difference_levels(captures: Captures, along: str) -> NDArray[np.float32]:
    """Return by line the rms difference of the captures, smoothed along it, without its mean."""
    difference = captures.second.astype(np.float32) - captures.first
    lines = difference if along == "row" else difference.transpose(1, 0, 2)
    smooth = np.asarray(cv2.blur(np.ascontiguousarray(lines), (_BLUR_PX, 2)), np.float32)
    return np.asarray(np.sqrt(np.square(smooth - smooth.mean(axis=1, keepdims=True)).mean(axis=(1, 2))), np.float32)
