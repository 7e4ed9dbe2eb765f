"""Real presses of a ball on a sensor: read them, remove the slow drift of the light, show them on a contact sheet."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.errors import InputError
from slipguard.sim.raster import Field, f32

Image = NDArray[np.uint8]
NEAR_MM = 5.0
FAR_MM = 5.5
PX_PER_MM = 18.5
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
    """Return the presses listed in FOLDER/circles.csv. Raises InputError for missing or unreadable files."""
    table = folder / "circles.csv"
    if not table.is_file():
        raise InputError(f"{table} is missing; it lists file,cx,cy,r of each press")
    background = _read(folder / "background.png")
    with table.open(newline="", encoding="utf-8") as lines:
        rows = list(csv.DictReader(lines))
    return [
        press_of(row["file"], _read(folder / row["file"]), background, (float(row["cx"]), float(row["cy"])))
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


def write_sheet(presses: Sequence[RealPress], drawn: Sequence[Field], target: Path) -> None:
    """Write a PNG with four images per press, from top to bottom: real, rendered, and the difference of each."""
    columns = []
    for press, change in zip(presses, drawn, strict=True):
        drift = press.image.astype(np.float32) - press.background - press.difference
        images = (
            press.image,
            press.background + drift + change,
            press.difference + 128,
            change + 128,
        )
        column = np.vstack([np.clip(np.rint(image), 0, 255).astype(np.uint8) for image in images])
        columns.append(cv2.resize(column, None, fx=0.6, fy=0.6, interpolation=cv2.INTER_AREA))
    if not cv2.imwrite(str(target), np.hstack(columns)):
        raise InputError(f"{target} cannot be written; name a .png in a folder that exists")


def _read(path: Path) -> Image:
    image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if image is None:
        raise InputError(f"{path} is missing or not an image")
    return np.asarray(image, np.uint8)
