"""Rotations of known size on real pixels, and how well the pipeline estimates them.

Semi-synthetic, because no public DIGIT recording has a measured rotation: a real press is cut out of its frame,
rotated, and placed on the background image. `relit` reads the colors as the gel's slope under lights at 30, 150 and 270
degrees, rotates the slopes with the object and keeps the lights; `rigid` rotates the colors themselves, which no sensor
does: it makes matching exact by construction and flatters registration.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

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
from slipguard.perception.pipeline import ContactSegmenter, Pipeline
from slipguard.perception.settings import PerceptionSettings
from slipguard.sim.raster import Field, f32
from slipguard.sim.sensor_unit import NOISE_STD_BGR, STRIPE_STD_BGR, CameraNoise
from tests.campaigns.real_frames import RealFrame, indenter_frames, sphere_frames

RotationMethod = Literal["relit", "rigid"]
ROTATION_METHODS: tuple[RotationMethod, ...] = ("relit", "rigid")
Image = NDArray[np.uint8]
LIGHTS_DEG = (270.0, 150.0, 30.0)
"""Azimuths of the blue, green and red light, counter-clockwise from the image's right."""
ROTATION_DEG = (10.0, 30.0)
RATE_DEG_S = (40.0, 300.0)
SOFT_PX = 1.2
"""Blur that removes the frame's noise, which would rotate along like the object's texture."""
FEATHER_PX = 8.0
SKIRT_PX = 18
"""Margin of the cut-out around the labeled contact, as far as its slopes are visible."""
INSIDE_PX = 6
"""A press whose contact is this close to the edge of the frame is omitted, because it may continue outside."""
DRIFT_LEVELS = 3.0
"""Maximum change of the light against the background image, gray levels per channel."""
PX_PER_MM = 18.5


@dataclass(frozen=True, slots=True, eq=False)
class PressImage:
    """One real press.

    Attributes:
        part: "tune" or "test".
        readable: whether the contact has an axis.
        difference: (320, 240, 3) float32 BGR, frame minus background image, 0 away from the contact.
        contact: (320, 240) uint8, 0 or 1.
    """

    name: str
    part: str
    readable: bool
    background: Image
    difference: Field
    contact: NDArray[np.uint8]
    center_px: tuple[float, float]


def press_images(folder: Path) -> Iterator[PressImage]:
    """Yield the presses of `taxim_sphere`, then `anytouch2_force2`, whose contact is entirely in the frame.

    Raises InputError if neither folder exists or a file cannot be read.
    """
    balls, indenter = folder / "taxim_sphere", folder / "anytouch2_force2"
    if not balls.is_dir() and not indenter.is_dir():
        raise InputError(f"{folder}: neither taxim_sphere nor anytouch2_force2 is in this folder")
    for frame in (
        *(sphere_frames(balls) if balls.is_dir() else ()),
        *(indenter_frames(indenter) if indenter.is_dir() else ()),
    ):
        yield from _press(frame, readable=frame.group == indenter.name)


def rotated_grasp(press: PressImage, way: RotationMethod, seed: int) -> RenderedGrasp:
    """Return a grasp in which a press rotates about its patch's center, with new noise in each frame."""
    rng = np.random.default_rng(np.random.SeedSequence([seed, *press.name.encode()]))
    noise = CameraNoise(NOISE_STD_BGR, STRIPE_STD_BGR, int(rng.integers(2**31)))
    base = f32(press.background + rng.uniform(-DRIFT_LEVELS, DRIFT_LEVELS, 3))
    shots = []
    for index, (share, rotation) in enumerate(_motion(rng)):
        image = base if share == 0.0 else base + np.float32(share) * rotated_difference(press, rotation, way)
        noisy = np.clip(np.rint(image + noise.next()), 0, 255).astype(np.uint8)
        compared = index >= EMPTY_FRAMES + CLOSING_FRAMES + STILL_FRAMES and share > 0.0
        shots.append(GraspFrame(Frame(noisy, index * FRAME_S, index), share > 0.0, rotation, compared, None))
    return RenderedGrasp(press.name, press.readable, press.background, NOISE_STD_BGR, PX_PER_MM, tuple(shots))


def rotated_difference(press: PressImage, rotation_deg: float, way: RotationMethod) -> Field:
    """Return the image change by the press, rotated counter-clockwise: (320, 240, 3) float32 gray levels."""
    affine = cv2.getRotationMatrix2D(press.center_px, rotation_deg, 1.0)
    size = (FRAME_WIDTH_PX, FRAME_HEIGHT_PX)
    moved = np.asarray(cv2.warpAffine(press.difference, affine, size, flags=cv2.INTER_CUBIC), np.float32)
    return moved if way == "rigid" else f32(cv2.transform(moved, _relighting(rotation_deg)))


def _relighting(rotation_deg: float) -> NDArray[np.float32]:
    """Return (3, 3): colors -> slope and common brightness -> rotated slope -> colors."""
    azimuth = np.radians(np.asarray(LIGHTS_DEG))
    colors = np.stack([np.cos(azimuth), np.sin(azimuth), np.ones(3)], axis=1)
    c, s = math.cos(math.radians(rotation_deg)), math.sin(math.radians(rotation_deg))
    rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return np.asarray(colors @ rotation @ np.linalg.inv(colors), np.float32)


def _motion(rng: np.random.Generator) -> Iterator[tuple[float, float]]:
    """Yield share of the press and rotation per frame: no contact, closing, still, rotating, still, no contact."""
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


def _press(frame: RealFrame, *, readable: bool) -> Iterator[PressImage]:
    contact = np.asarray(frame.mask, np.uint8)
    x, y, w, h = cv2.boundingRect(contact)
    if x < INSIDE_PX or y < INSIDE_PX or x + w > FRAME_WIDTH_PX - INSIDE_PX or y + h > FRAME_HEIGHT_PX - INSIDE_PX:
        return
    assert frame.background is not None
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * SKIRT_PX + 1, 2 * SKIRT_PX + 1))
    wide = cv2.dilate(contact, disc)
    difference = _without_drift(f32(frame.image.astype(np.float32) - frame.background), wide > 0)
    inside = cv2.distanceTransform(np.pad(wide, 1), cv2.DIST_L2, 5)[1:-1, 1:-1]
    feather = np.clip(inside / FEATHER_PX, 0.0, 1.0)[..., None]
    soft = cv2.GaussianBlur(difference, (0, 0), SOFT_PX)
    m = cv2.moments(contact, True)
    center = (m["m10"] / m["m00"], m["m01"] / m["m00"])
    name = f"{frame.group}/{frame.name}"
    yield PressImage(name, frame.split, readable, frame.background, f32(soft * feather), contact, center)


def _without_drift(difference: Field, near: NDArray[np.bool_]) -> Field:
    """Return the difference minus a quadratic fitted away from the contact: the light drifts between frames."""
    y, x = np.mgrid[0:FRAME_HEIGHT_PX, 0:FRAME_WIDTH_PX].astype(np.float32)
    x, y = x / FRAME_WIDTH_PX - 0.5, y / FRAME_HEIGHT_PX - 0.5
    terms = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)
    drift, *_ = np.linalg.lstsq(terms[~near][::7], difference[~near][::7], rcond=None)
    return f32(difference - terms @ drift)


SEED = 1
CONFIDENT_SIGMAS = 3.0


@dataclass(frozen=True, slots=True)
class PressResult:
    """The estimates of one rotated press.

    Attributes:
        errors_deg: (error, sigma) of every frame with an estimate.
        frames: all compared frames.
        confident: estimates above three sigmas for a contact without observable rotation (a ball).
    """

    name: str
    readable: bool
    errors_deg: tuple[tuple[float, float], ...]
    frames: int
    confident: int

    @property
    def mean_deg(self) -> float | None:
        """Mean absolute error; None without estimates."""
        return float(np.mean([abs(error) for error, _ in self.errors_deg])) if self.errors_deg else None


@dataclass(frozen=True, slots=True)
class PressStatistics:
    """The figures of one data set, in degrees; None without estimates."""

    data: str
    way: RotationMethod
    sequences: int
    frames: int
    mean_deg: float | None
    worst_sequence_deg: float | None
    p95_deg: float | None
    within_1_sigma: float | None
    within_2_sigma: float | None
    declined_share: float
    confident_round_rotations: int


def measure_presses(
    folder: Path,
    part: str,
    way: RotationMethod,
    segmenter: ContactSegmenter,
    progress: Callable[[str, float], None] = lambda _what, _share: None,
) -> list[PressResult]:
    """Rotate every press of one part ("tune", "test" or "all") and process it like the daemon.

    Raises InputError for another part, and if the folder holds no press of it.
    """
    if part not in ("tune", "test", "all"):
        raise InputError(f"part {part!r}: there are tune, test, all")
    chosen = [press for press in press_images(folder) if part in (press.part, "all")]
    if not chosen:
        raise InputError(f"{folder}: no press of the part {part!r} is entirely in its frame")
    out = []
    for index, press in enumerate(chosen):
        progress(press.name, index / len(chosen))
        out.append(_result(press, way, segmenter))
    return out


def press_statistics(found: Iterable[PressResult], way: RotationMethod) -> list[PressStatistics]:
    """Return one row per data set."""
    sets: dict[str, list[PressResult]] = {}
    for one in found:
        sets.setdefault(one.name.split("/")[0], []).append(one)
    return [_statistics(name, way, results) for name, results in sets.items()]


def _result(press: PressImage, way: RotationMethod, segmenter: ContactSegmenter) -> PressResult:
    grasp = rotated_grasp(press, way, SEED)
    pipeline = Pipeline(segmenter, PerceptionSettings(), grasp.background, grasp.noise_bgr, grasp.px_per_mm)
    errors, frames, confident = [], 0, 0
    for shot in grasp.shots:
        estimate = pipeline.process(shot.frame)
        if not shot.compared:
            continue
        frames += 1
        if estimate.rotation_deg is not None and estimate.sigma_deg is not None:
            errors.append((estimate.rotation_deg - shot.rotation_deg, estimate.sigma_deg))
            confident += not press.readable and abs(estimate.rotation_deg) > CONFIDENT_SIGMAS * estimate.sigma_deg
    return PressResult(press.name, press.readable, tuple(errors), frames, confident)


def _statistics(data: str, way: RotationMethod, results: list[PressResult]) -> PressStatistics:
    pairs = np.array([pair for one in results for pair in one.errors_deg], np.float64).reshape(-1, 2)
    errors, sigmas = np.abs(pairs[:, 0]), pairs[:, 1]
    frames = sum(one.frames for one in results)
    means = [one.mean_deg for one in results if one.mean_deg is not None]
    some = len(errors) > 0
    return PressStatistics(
        data=data,
        way=way,
        sequences=len(results),
        frames=frames,
        mean_deg=_rounded(errors.mean()) if some else None,
        worst_sequence_deg=_rounded(max(means)) if means else None,
        p95_deg=_rounded(np.quantile(errors, 0.95)) if some else None,
        within_1_sigma=_rounded(np.mean(errors <= sigmas)) if some else None,
        within_2_sigma=_rounded(np.mean(errors <= 2.0 * sigmas)) if some else None,
        declined_share=_rounded(1.0 - len(errors) / max(frames, 1)),
        confident_round_rotations=sum(one.confident for one in results),
    )


def _rounded(value: Any) -> float:
    return round(float(value), 4)
