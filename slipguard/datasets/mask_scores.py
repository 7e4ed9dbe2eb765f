"""Scores that compare two masks, and the labeled real frames on which networks are scored."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.errors import InputError

TUNING_SPHERES = frozenset(f"{n:02d}.png" for n in range(15))
TUNING_INDENTER_LAST = "f0132"


def iou(a: NDArray[np.bool_], b: NDArray[np.bool_]) -> float:
    """Return the intersection over union of two masks of one shape; 1.0 if both are empty."""
    union = int(np.count_nonzero(a | b))
    return 1.0 if union == 0 else float(np.count_nonzero(a & b)) / union


def dice(a: NDArray[np.bool_], b: NDArray[np.bool_]) -> float:
    """Return the Dice coefficient of two masks of one shape; 1.0 if both are empty."""
    total = int(np.count_nonzero(a)) + int(np.count_nonzero(b))
    return 1.0 if total == 0 else 2.0 * float(np.count_nonzero(a & b)) / total


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


def read_bgr(path: Path) -> NDArray[np.uint8]:
    """Return the image of a file, (H, W, 3) uint8 BGR. Raises InputError if it cannot be read."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    image = cv2.imdecode(np.frombuffer(data or b"\0", np.uint8), cv2.IMREAD_COLOR)
    if image is None:
        raise InputError(f"{path}: not a readable image; remove or replace it")
    return np.asarray(image, np.uint8)


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
