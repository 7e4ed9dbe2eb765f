"""The labeled real frames on which networks are scored. They are not part of the project."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.errors import InputError
from slipguard.tools.image_files import read_bgr

TUNING_SPHERES = frozenset(f"{n:02d}.png" for n in range(15))
TUNING_INDENTER_LAST = "f0132"


@dataclass(frozen=True, slots=True, eq=False)
class RealFrame:
    """One labeled real gel image.

    Attributes:
        split: "tune" or "test"; report only figures from "test".
        image: (320, 240, 3) uint8 BGR.
        background: the unit's background image, same shape, or None if unknown.
        mask: (320, 240) bool, the labeled contact region; all False without contact.
    """

    name: str
    group: str
    split: str
    image: NDArray[np.uint8]
    background: NDArray[np.uint8] | None
    mask: NDArray[np.bool_]


def real_frames(folder: Path) -> list[RealFrame]:
    """Return the labeled contact frames in `folder` (`taxim_sphere`, `anytouch2_force2`, `aurova`)."""
    mask = read_bgr(folder / "aurova" / "mask.png")[..., 0] > 127
    handle = RealFrame("frame", "aurova", "test", read_bgr(folder / "aurova" / "frame.png"), None, mask)
    return [*sphere_frames(folder / "taxim_sphere"), *indenter_frames(folder / "anytouch2_force2"), handle]


def sphere_frames(folder: Path) -> list[RealFrame]:
    """Return the presses of a ball listed in FOLDER/circles.csv (file, cx, cy, r). Raises InputError."""
    table = folder / "circles.csv"
    if not table.is_file():
        raise InputError(f"{table}: missing; it must list file,cx,cy,r of each press")
    background = read_bgr(folder / "background.png")
    with table.open(newline="", encoding="utf-8") as lines:
        rows = list(csv.DictReader(lines))
    out = []
    for row in rows:
        disc = np.zeros(background.shape[:2], np.uint8)
        cv2.circle(disc, (round(float(row["cx"])), round(float(row["cy"]))), round(float(row["r"])), (1.0,), -1)
        split = "tune" if row["file"] in TUNING_SPHERES else "test"
        image = read_bgr(folder / row["file"])
        out.append(RealFrame(row["file"][:-4], folder.name, split, image, background, disc > 0))
    return out


def indenter_frames(folder: Path) -> list[RealFrame]:
    """Return the presses of an indenter in FOLDER/frames with FOLDER/masks. Raises InputError."""
    background = read_bgr(folder / "background.png")
    out = []
    for path in sorted((folder / "frames").glob("*.png")):
        mask = read_bgr(folder / "masks" / path.name)[..., 0] > 127
        split = "tune" if path.stem <= TUNING_INDENTER_LAST else "test"
        out.append(RealFrame(path.stem, folder.name, split, read_bgr(path), background, mask))
    return out
