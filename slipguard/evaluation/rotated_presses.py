"""Turns of known size on real pixels: a real press is cut out of its frame, turned, and laid on the no-contact image.

Semi-synthetic: no public recording of a DIGIT has a measured turn. `relit` reads the colours as the gel's slope under
lights at 30, 150 and 270 degrees, turns the slopes with the object and leaves the lights where they are; `rigid` turns
the colours themselves, which no sensor does: it makes matching exact by construction and flatters registration.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.datasets.rendered_grasps import (
    CLOSING_FRAMES,
    EMPTY_FRAMES,
    END_FRAMES,
    FRAME_S,
    STILL_FRAMES,
    GraspFrame,
    RenderedGrasp,
)
from slipguard.devices import FRAME_HEIGHT_PX, FRAME_WIDTH_PX, Frame
from slipguard.errors import InputError
from slipguard.sim.camera_noise import CameraNoise
from slipguard.sim.raster import Field, f32
from slipguard.sim.sensor_unit import NOISE_STD_BGR, STRIPE_STD_BGR
from slipguard.tools.image_files import read_gel_image

RotationMethod = Literal["relit", "rigid"]
ROTATION_METHODS: tuple[RotationMethod, ...] = ("relit", "rigid")
Image = NDArray[np.uint8]
LIGHTS_DEG = (270.0, 150.0, 30.0)
"""Azimuths of the blue, green and red light, counter-clockwise from the picture's right."""
ROTATION_DEG = (10.0, 30.0)
RATE_DEG_S = (40.0, 300.0)
SOFT_PX = 1.2
"""Blur that takes the frame's own noise off the press: it would turn along as if it were the object's texture."""
FEATHER_PX = 8.0
SKIRT_PX = 18
"""The cut-out goes this far beyond the labelled contact, as far as its slopes are seen."""
INSIDE_PX = 6
"""A press whose contact comes this close to the edge of the frame is left out: what lies beyond it is not known."""
DRIFT_LEVELS = 3.0
"""The light differs from that of the no-contact image by up to so many grey levels in each colour."""
PX_PER_MM = 18.5


@dataclass(frozen=True, slots=True, eq=False)
class PressImage:
    """One real press. difference: (320, 240, 3) float32 BGR, frame less no-contact image, 0 away from the contact.

    contact: (320, 240) uint8, 0 or 1. part: "tune" or "test". readable: whether the contact has an axis.
    """

    name: str
    part: str
    readable: bool
    background: Image
    difference: Field
    contact: NDArray[np.uint8]
    centre_px: tuple[float, float]


def press_images(folder: Path) -> Iterator[PressImage]:
    """The presses under FOLDER whose contact lies wholly in the frame: `taxim_sphere`, then `anytouch2_force2`.

    Raises `InputError` where neither is there or a file cannot be read.
    """
    balls, indenter = folder / "taxim_sphere", folder / "anytouch2_force2"
    if not balls.is_dir() and not indenter.is_dir():
        raise InputError(f"{folder}: neither taxim_sphere nor anytouch2_force2 is in this folder")
    if balls.is_dir():
        background = read_gel_image(balls / "background.png")
        for index, (file, contact) in enumerate(_discs(balls / "circles.csv")):
            part = "tune" if index < 15 else "test"
            image = read_gel_image(balls / file)
            yield from _press(f"{balls.name}/{Path(file).stem}", part, False, image, background, contact)
    if indenter.is_dir():
        background = read_gel_image(indenter / "background.png")
        for path in sorted((indenter / "masks").glob("*.png")):
            mask = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
            if mask is None:
                raise InputError(f"{path}: not a readable mask")
            part = "tune" if path.stem <= "f0132" else "test"
            image = read_gel_image(indenter / "frames" / path.name)
            yield from _press(
                f"{indenter.name}/{path.stem}", part, True, image, background, np.asarray(mask > 0, np.uint8)
            )


def rotated_grasp(press: PressImage, way: RotationMethod, seed: int) -> RenderedGrasp:
    """A grasp that turns a press about its patch's centre, frame by frame, with fresh noise; the same for one seed."""
    rng = np.random.default_rng(np.random.SeedSequence([seed, *press.name.encode()]))
    noise = CameraNoise(NOISE_STD_BGR, STRIPE_STD_BGR, int(rng.integers(2**31)))
    base = f32(press.background + rng.uniform(-DRIFT_LEVELS, DRIFT_LEVELS, 3))
    shots = []
    for index, (share, rotation) in enumerate(_course(rng)):
        image = base if share == 0.0 else base + np.float32(share) * rotated_difference(press, rotation, way)
        noisy = np.clip(np.rint(image + noise.next()), 0, 255).astype(np.uint8)
        compared = index >= EMPTY_FRAMES + CLOSING_FRAMES + STILL_FRAMES and share > 0.0
        shots.append(GraspFrame(Frame(noisy, index * FRAME_S, index), share > 0.0, rotation, compared, None))
    return RenderedGrasp(press.name, press.readable, press.background, NOISE_STD_BGR, PX_PER_MM, tuple(shots))


def rotated_difference(press: PressImage, rotation_deg: float, way: RotationMethod) -> Field:
    """What the press, turned counter-clockwise as seen, changes in the picture: (320, 240, 3) float32 grey levels."""
    affine = cv2.getRotationMatrix2D(press.centre_px, rotation_deg, 1.0)
    size = (FRAME_WIDTH_PX, FRAME_HEIGHT_PX)
    moved = np.asarray(cv2.warpAffine(press.difference, affine, size, flags=cv2.INTER_CUBIC), np.float32)
    return moved if way == "rigid" else f32(cv2.transform(moved, _relighting(rotation_deg)))


def _relighting(rotation_deg: float) -> NDArray[np.float32]:
    """(3, 3): colours -> slope and common brightness -> slope turned -> colours."""
    azimuth = np.radians(np.asarray(LIGHTS_DEG))
    colours = np.stack([np.cos(azimuth), np.sin(azimuth), np.ones(3)], axis=1)
    c, s = math.cos(math.radians(rotation_deg)), math.sin(math.radians(rotation_deg))
    rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return np.asarray(colours @ rotation @ np.linalg.inv(colours), np.float32)


def _course(rng: np.random.Generator) -> Iterator[tuple[float, float]]:
    """Share of the press and turn, frame by frame: no contact, closing, still, turning, still, no contact."""
    total = float(rng.uniform(*ROTATION_DEG) * rng.choice([-1.0, 1.0]))
    peak = float(math.exp(rng.uniform(math.log(RATE_DEG_S[0]), math.log(RATE_DEG_S[1]))))
    rotating = max(math.ceil(1.5 * abs(total) / peak / FRAME_S), 4)  # a smooth step's peak is 1.5 times its mean
    yield from ((0.0, 0.0) for _ in range(EMPTY_FRAMES))
    yield from ((k / CLOSING_FRAMES, 0.0) for k in range(1, CLOSING_FRAMES + 1))
    yield from ((1.0, 0.0) for _ in range(STILL_FRAMES))
    for k in range(1, rotating + END_FRAMES + 1):
        part = min(k / rotating, 1.0)
        yield 1.0, total * part * part * (3.0 - 2.0 * part)
    yield 0.0, 0.0


def _press(
    name: str, part: str, readable: bool, image: Image, background: Image, contact: NDArray[np.uint8]
) -> Iterator[PressImage]:
    x, y, w, h = cv2.boundingRect(contact)
    if x < INSIDE_PX or y < INSIDE_PX or x + w > FRAME_WIDTH_PX - INSIDE_PX or y + h > FRAME_HEIGHT_PX - INSIDE_PX:
        return
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * SKIRT_PX + 1, 2 * SKIRT_PX + 1))
    wide = cv2.dilate(contact, disc)
    difference = _without_drift(f32(image.astype(np.float32) - background), wide > 0)
    inside = cv2.distanceTransform(np.pad(wide, 1), cv2.DIST_L2, 5)[1:-1, 1:-1]
    feather = np.clip(inside / FEATHER_PX, 0.0, 1.0)[..., None]
    soft = cv2.GaussianBlur(difference, (0, 0), SOFT_PX)
    m = cv2.moments(contact, True)
    centre = (m["m10"] / m["m00"], m["m01"] / m["m00"])
    yield PressImage(name, part, readable, background, f32(soft * feather), contact, centre)


def _without_drift(difference: Field, near: NDArray[np.bool_]) -> Field:
    """Less a quadratic fitted away from the contact: the light drifts between frames."""
    y, x = np.mgrid[0:FRAME_HEIGHT_PX, 0:FRAME_WIDTH_PX].astype(np.float32)
    x, y = x / FRAME_WIDTH_PX - 0.5, y / FRAME_HEIGHT_PX - 0.5
    terms = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)
    drift, *_ = np.linalg.lstsq(terms[~near][::7], difference[~near][::7], rcond=None)
    return f32(difference - terms @ drift)


def _discs(table: Path) -> Iterator[tuple[str, NDArray[np.uint8]]]:
    if not table.is_file():
        raise InputError(f"{table} is missing; it lists file,cx,cy,r of each press")
    with table.open(newline="", encoding="utf-8") as lines:
        for row in csv.DictReader(lines):
            mask = np.zeros((FRAME_HEIGHT_PX, FRAME_WIDTH_PX), np.uint8)
            cv2.circle(mask, (round(float(row["cx"])), round(float(row["cy"]))), round(float(row["r"])), (1.0,), -1)
            yield row["file"], mask
