"""How well masks agree, and the labelled real frames they are judged on."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.errors import InputError

NOISE_BGR = (2.9, 1.5, 2.4)
"""Temporal noise of two real units, standard deviation in grey levels per channel."""
NOISE_BLUR_PX = 0.85
"""Gaussian blur that gives white noise the measured correlation of 0.65 between neighbouring pixels."""

TUNING_SPHERES = frozenset(f"{n:02d}.png" for n in range(15))
TUNING_INDENTER_LAST = "f0132"
TUNING_BACKGROUNDS = 3


def iou(a: NDArray[np.bool_], b: NDArray[np.bool_]) -> float:
    """Intersection over union of two masks of one shape; two empty masks agree fully (1.0)."""
    union = int(np.count_nonzero(a | b))
    return 1.0 if union == 0 else float(np.count_nonzero(a & b)) / union


def dice(a: NDArray[np.bool_], b: NDArray[np.bool_]) -> float:
    """Dice coefficient of two masks of one shape; two empty masks agree fully (1.0)."""
    total = int(np.count_nonzero(a)) + int(np.count_nonzero(b))
    return 1.0 if total == 0 else 2.0 * float(np.count_nonzero(a & b)) / total


@dataclass(frozen=True, slots=True, eq=False)
class RealFrame:
    """One real gel image and what is known about it.

    image: (320, 240, 3) uint8 BGR. background: the unit's no-contact image, same shape, or None if unknown.
    mask: (320, 240) bool, the labelled contact region; all False on a no-contact frame.
    split: "tune" or "test"; figures to be believed come from "test" alone.
    """

    name: str
    group: str
    split: str
    image: NDArray[np.uint8]
    background: NDArray[np.uint8] | None
    mask: NDArray[np.bool_]


def read_bgr(path: Path) -> NDArray[np.uint8]:
    """A colour image (H, W, 3) uint8 BGR. Raises `InputError` naming the file where there is none."""
    image = cv2.imread(str(path), cv2.IMREAD_COLOR) if path.is_file() else None
    if image is None:
        raise InputError(f"{path}: no image could be read here; give a PNG or JPEG file")
    return np.asarray(image, np.uint8)


def real_frames(folder: Path) -> list[RealFrame]:
    """Every labelled contact frame under `folder` (`taxim_sphere`, `anytouch2_force2`, `aurova`), by name."""
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
    """A no-contact frame of the same unit later: each channel off by up to 5 grey levels, fresh camera noise."""
    white = rng.standard_normal(background.shape).astype(np.float32)
    noise = np.asarray(cv2.GaussianBlur(white, (0, 0), NOISE_BLUR_PX), np.float32)
    noise *= np.asarray(NOISE_BGR, np.float32) / noise.std((0, 1))
    light = rng.uniform(-5, 5, 3).astype(np.float32)
    return np.asarray(np.clip(np.rint(background + noise + light), 0, 255), np.uint8)


def no_contact_frames(folder: Path, days: int, seed: int = 0) -> list[RealFrame]:
    """`days` other-day frames of each of the units in `folder/backgrounds`, each with its own no-contact image."""
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


def backgrounds_in(folder: Path) -> list[NDArray[np.uint8]]:
    """The no-contact images of a folder, sorted by name, each (320, 240, 3) uint8 BGR.

    Raises `InputError` for a folder without images or an image of another size.
    """
    paths = sorted(path for path in folder.glob("*") if path.suffix.lower() in (".png", ".jpg", ".jpeg"))
    if not paths:
        raise InputError(f"{folder}: no PNG or JPEG image here; name a folder of no-contact images")
    images = [read_bgr(path) for path in paths]
    for path, image in zip(paths, images, strict=True):
        if image.shape != (320, 240, 3):
            raise InputError(f"{path}: {image.shape[1]}x{image.shape[0]}; a no-contact image of 240x320 is needed")
    return images
