"""Scores that compare two masks, and the labeled real frames on which networks are scored."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.errors import InputError

NOISE_BGR = (2.9, 1.5, 2.4)
"""Temporal noise of two real units, standard deviation in gray levels per channel."""
NOISE_BLUR_PX = 0.85
"""Gaussian blur that gives white noise the measured correlation of 0.65 between neighboring pixels."""

TUNING_SPHERES = frozenset(f"{n:02d}.png" for n in range(15))
TUNING_INDENTER_LAST = "f0132"
TUNING_BACKGROUNDS = 3


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
    return [*_spheres(folder / "taxim_sphere"), *_indenter(folder / "anytouch2_force2"), *_aurova(folder / "aurova")]


def _spheres(folder: Path) -> list[RealFrame]:
    background = read_bgr(folder / "background.png")
    with (folder / "circles.csv").open(newline="") as table:
        rows = list(csv.DictReader(table))
    out = []
    for row in rows:
        disc = np.zeros(background.shape[:2], np.uint8)
        cv2.circle(disc, (int(row["cx"]), int(row["cy"])), int(row["r"]), (1.0,), -1)
        split = "tune" if row["file"] in TUNING_SPHERES else "test"
        image = read_bgr(folder / row["file"])
        out.append(RealFrame(row["file"][:-4], folder.name, split, image, background, disc > 0))
    return out


def _indenter(folder: Path) -> list[RealFrame]:
    background = read_bgr(folder / "background.png")
    out = []
    for path in sorted((folder / "frames").glob("*.png")):
        mask = read_bgr(folder / "masks" / path.name)[..., 0] > 127
        split = "tune" if path.stem <= TUNING_INDENTER_LAST else "test"
        out.append(RealFrame(path.stem, folder.name, split, read_bgr(path), background, mask))
    return out


def _aurova(folder: Path) -> list[RealFrame]:
    mask = read_bgr(folder / "mask.png")[..., 0] > 127
    return [RealFrame("frame", folder.name, "test", read_bgr(folder / "frame.png"), None, mask)]


def another_day(background: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
    """Return a later frame without contact: each channel off by up to 5 gray levels, new camera noise."""
    white = rng.standard_normal(background.shape).astype(np.float32)
    noise = np.asarray(cv2.GaussianBlur(white, (0, 0), NOISE_BLUR_PX), np.float32)
    noise *= np.asarray(NOISE_BGR, np.float32) / noise.std((0, 1))
    light = rng.uniform(-5, 5, 3).astype(np.float32)
    return np.asarray(np.clip(np.rint(background + noise + light), 0, 255), np.uint8)


def no_contact_frames(folder: Path, days: int, seed: int = 0) -> list[RealFrame]:
    """Return `days` later frames without contact of each unit in `folder/backgrounds`, with its background image."""
    rng = np.random.default_rng(seed)
    nothing = np.zeros((320, 240), np.bool_)
    out = []
    for number, path in enumerate(sorted((folder / "backgrounds").glob("*.png"))):
        background = read_bgr(path)
        split = "tune" if number < TUNING_BACKGROUNDS else "test"
        for day in range(days):
            image = another_day(background, rng)
            out.append(RealFrame(f"{path.stem}-{day}", "backgrounds", split, image, background, nothing))
    return out
