"""Real presses of a ball: read them, remove the slow drift of the light, and render the same presses."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.devices import FRAME_HEIGHT_PX, FRAME_WIDTH_PX
from slipguard.sim.gel_view import GelView
from slipguard.sim.height_raster import HeightRaster
from slipguard.sim.imprint import Imprinter
from slipguard.sim.raster import Field, f32
from slipguard.sim.sensor_unit import SensorUnit
from slipguard.sim.shapes import sphere
from slipguard.tools.image_files import read_bgr

Image = NDArray[np.uint8]
Vector = NDArray[np.float64]
NEAR_MM, FAR_MM, PX_PER_MM = 5.0, 5.5, 18.5
BALL_RADIUS_MM = 4.28
"""Fitted together with the optics of `SensorUnit`."""
POSE_STEPS = np.array([0.03, 0.03, 0.03])
"""Steps of the derivatives in x, y and depth, mm: half a pixel."""
_REDUCTION = 2


@dataclass(frozen=True, slots=True, eq=False)
class RealPress:
    """One press.

    Attributes:
        image, background: (320, 240, 3) uint8 BGR.
        center_px: (column, row) of the visible contact.
        difference: image - background, (320, 240, 3) float32, minus a quadratic fitted away from the contact (the
            light drifts between frames).
        near: (320, 240) bool, within 5 mm of the center.
    """

    name: str
    image: Image
    background: Image
    center_px: tuple[float, float]
    difference: Field
    near: NDArray[np.bool_]

    def reduced(self, image: Field) -> Field:
        """Return an image's values near the press, at half the resolution, as a vector."""
        size = (image.shape[1] // _REDUCTION, image.shape[0] // _REDUCTION)
        small = f32(cv2.resize(image, size, interpolation=cv2.INTER_AREA))
        near = self.near[::_REDUCTION, ::_REDUCTION]
        return small[near].ravel()


def read_presses(folder: Path) -> list[RealPress]:
    """Return the presses listed in FOLDER/circles.csv."""
    table = folder / "circles.csv"
    background = read_bgr(folder / "background.png")
    with table.open(newline="", encoding="utf-8") as lines:
        rows = list(csv.DictReader(lines))
    return [
        press_of(row["file"], read_bgr(folder / row["file"]), background, (float(row["cx"]), float(row["cy"])))
        for row in rows
    ]


def press_of(name: str, image: Image, background: Image, center_px: tuple[float, float]) -> RealPress:
    """Return one press with its drift removed."""
    rows, columns = np.mgrid[0 : image.shape[0], 0 : image.shape[1]].astype(np.float32)
    distance_mm = np.hypot(columns - center_px[0], rows - center_px[1]) / PX_PER_MM
    raw = image.astype(np.float32) - background
    x, y = columns / image.shape[1] - 0.5, rows / image.shape[0] - 0.5
    terms = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)
    far = distance_mm > FAR_MM
    drift, *_ = np.linalg.lstsq(terms[far][::7], raw[far][::7], rcond=None)
    return RealPress(name, image, background, center_px, f32(raw - terms @ drift), distance_mm < NEAR_MM)


def refined_pose(unit: SensorUnit, radius_mm: float, press: RealPress, rounds: int = 8) -> Vector:
    """Return the pose (x_mm, y_mm, depth_mm) at which the rendered image is closest to a press."""
    imprinter, surface = Imprinter(unit, press.background), _ball(radius_mm)
    pose = start_pose(unit, press)
    target = press.reduced(press.difference)
    damping = 1e-2
    drawn = press.reduced(_drawn(imprinter, surface, pose))
    for _ in range(rounds):
        columns = [
            (press.reduced(_drawn(imprinter, surface, pose + step)) - drawn) / step.sum()
            for step in np.diag(POSE_STEPS)
        ]
        slopes = np.stack(columns, axis=1)
        gram, right = slopes.T @ slopes, slopes.T @ (target - drawn)
        for _ in range(4):
            trial = pose + np.clip(np.linalg.solve(gram + damping * np.diag(np.diag(gram)), right), -0.4, 0.4)
            trial[2] = np.clip(trial[2], 0.1, 3.0)
            redrawn = press.reduced(_drawn(imprinter, surface, trial))
            if np.sum((target - redrawn) ** 2) < np.sum((target - drawn) ** 2):
                pose, drawn, damping = trial, redrawn, damping / 4
                break
            damping *= 5
        else:
            break
    return pose


def start_pose(unit: SensorUnit, press: RealPress) -> Vector:
    """Return an initial pose from the labeled circle."""
    x = (press.center_px[0] - (FRAME_WIDTH_PX - 1) / 2) / unit.px_per_mm
    y = -(press.center_px[1] - (FRAME_HEIGHT_PX - 1) / 2) / unit.px_per_mm
    return np.array([x, y, 1.3])


def drawn_difference(unit: SensorUnit, radius_mm: float, press: RealPress, pose: Vector) -> Field:
    """Return the rendered change of a ball press against the background, (320, 240, 3) float32 gray levels."""
    return _drawn(Imprinter(unit, press.background), _ball(radius_mm), pose)


def correlation(press: RealPress, drawn: Field) -> float:
    """Return the Pearson correlation of real and rendered difference image within 5 mm of the press, all channels."""
    real = press.difference[press.near]
    return float(np.corrcoef(real.ravel(), drawn[press.near].ravel())[0, 1])


def _ball(radius_mm: float) -> HeightRaster:
    return HeightRaster.of(lambda u, v: sphere(u, v, radius_mm), 4.0, 24.0)


def _drawn(imprinter: Imprinter, surface: HeightRaster, pose: Vector) -> Field:
    view = GelView("ball", x_mm=float(pose[0]), y_mm=float(pose[1]), depth_mm=float(pose[2]))
    imprint = imprinter.imprint(view, 0.0, surface)
    image = np.zeros((FRAME_HEIGHT_PX, FRAME_WIDTH_PX, 3), np.float32)
    if imprint is not None:
        image[imprint.window] = imprint.change_bgr
    return image
