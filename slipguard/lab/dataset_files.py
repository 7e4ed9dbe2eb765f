"""A rendered data set on disk: images, no-contact images, masks and a manifest; and a sheet to look at it."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.errors import InputError
from slipguard.lab.dataset import Sample, sample
from slipguard.sim.label import LABEL_NAME, label
from slipguard.sim.unit import FRAME_HEIGHT_PX, FRAME_WIDTH_PX

Image = NDArray[np.uint8]
MANIFEST_NAME = "manifest.jsonl"
IMAGE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".bmp"})
_SHEET_COLUMNS = 10
_SHEET_ROWS = 3


def check_request(out_dir: Path, count: int, seed: int, split: str) -> None:
    """Raise the InputError that `render_dataset` would raise before it writes anything."""
    if count < 1:
        raise InputError(f"{count} frames cannot be rendered; give a count of at least 1")
    if seed < 0:
        raise InputError(f"seed {seed} is negative; give 0 or more")
    if split not in ("train", "test"):
        raise InputError(f"no split {split!r}; there are: train, test")
    if out_dir.exists() and (not out_dir.is_dir() or any(out_dir.iterdir())):
        raise InputError(f"{out_dir} exists and is not an empty folder; name a new one")


def render_dataset(
    out_dir: Path,
    count: int,
    seed: int = 0,
    split: str = "train",
    backgrounds: Sequence[Image] | None = None,
    progress: Callable[[int], None] = lambda done: None,
) -> None:
    """Write `count` frames, seeds `seed` onwards, into a new or empty folder.

    images/, backgrounds/ and masks/ hold PNGs of one name, 240 wide x 320 high; masks are 0 or 255. manifest.jsonl has
    one line a frame: file, seed, split, object, has_contact, pose, share of the frame that is contact, name of the
    label. progress is called with the number of frames written. Raises InputError for a count that is not positive, a
    negative seed, an unknown split, a folder with something in it, or one that cannot be written.
    """
    check_request(out_dir, count, seed, split)
    folders = {name: out_dir / name for name in ("images", "backgrounds", "masks")}
    try:
        for folder in folders.values():
            folder.mkdir(parents=True)
        with (out_dir / MANIFEST_NAME).open("w", encoding="utf-8") as manifest:
            for index in range(count):
                drawn = sample(seed + index, backgrounds, split)
                mask = label(drawn.truth)
                name = f"{index:06d}.png"
                for key, image in (("images", drawn.image), ("backgrounds", drawn.background), ("masks", mask * 255)):
                    _write(folders[key] / name, np.asarray(image, np.uint8))
                manifest.write(json.dumps(_line(name, seed + index, split, drawn, mask)) + "\n")
                progress(index + 1)
    except OSError as error:
        raise InputError(f"{out_dir} cannot be written: {error.strerror or error}; name another folder") from error


def read_backgrounds(folder: Path) -> list[Image]:
    """All no-contact images of a folder, sorted by name, (320, 240, 3) uint8 BGR.

    Raises InputError for a folder that is missing or without images, and for an image that cannot be read or has
    another size.
    """
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder; name one with no-contact images")
    paths = sorted(path for path in folder.iterdir() if path.suffix.lower() in IMAGE_SUFFIXES)
    if not paths:
        raise InputError(
            f"{folder} holds no image ({', '.join(sorted(IMAGE_SUFFIXES))}); name one with no-contact images"
        )
    return [_background(path) for path in paths]


def contact_sheet(folder: Path, target: Path) -> None:
    """Write one picture of a rendered data set: evenly chosen frames with their mask's outline, difference below.

    Raises InputError where `folder` has no data set or `target` cannot be written.
    """
    images = sorted((folder / "images").glob("*.png"))
    if not images:
        raise InputError(f"{folder} holds no rendered data set (images/*.png); render one first")
    count = min(len(images), _SHEET_COLUMNS * _SHEET_ROWS)
    chosen = [images[k * len(images) // count] for k in range(count)]
    tiles = [_tile(folder, path.name) for path in chosen]
    columns = min(_SHEET_COLUMNS, count)
    tiles += [np.zeros_like(tiles[0])] * (-count % columns)
    rows = [np.hstack(tiles[k : k + columns]) for k in range(0, len(tiles), columns)]
    _write(target, np.vstack(rows))


def _line(name: str, seed: int, split: str, drawn: Sample, mask: Image) -> dict[str, Any]:
    pose = asdict(drawn.view)
    return {
        "file": name,
        "seed": seed,
        "split": split,
        "object": pose.pop("object_name"),
        "has_contact": drawn.has_contact,
        "contact_share": round(float(mask.mean()), 5),
        "label": LABEL_NAME,
        **{key: round(value, 4) for key, value in pose.items()},
    }


def _tile(folder: Path, name: str) -> Image:
    image, background, mask = (_read(folder / kind / name) for kind in ("images", "backgrounds", "masks"))
    outlines, _ = cv2.findContours(mask[..., 0], cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    difference = np.clip(image.astype(np.int16) - background + 128, 0, 255).astype(np.uint8)
    outlined = cv2.drawContours(image.copy(), outlines, -1, (255, 255, 255), 1)
    half = cv2.resize(np.vstack([outlined, difference]), None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    return np.asarray(half, np.uint8)


def _background(path: Path) -> Image:
    image = _read(path)
    height, width = image.shape[:2]
    if (height, width) != (FRAME_HEIGHT_PX, FRAME_WIDTH_PX):
        allowed = f"{FRAME_WIDTH_PX} wide x {FRAME_HEIGHT_PX} high"
        raise InputError(f"{path}: {width} wide x {height} high; a no-contact image is {allowed}")
    return image


def _read(path: Path) -> Image:
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror or error}") from error
    image = cv2.imdecode(np.frombuffer(data or b"\0", np.uint8), cv2.IMREAD_COLOR)
    if image is None:
        raise InputError(f"{path}: not an image that can be read; remove it or replace it")
    return np.asarray(image, np.uint8)


def _write(path: Path, image: Image) -> None:
    _, data = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 3])
    try:
        path.write_bytes(data.tobytes())
    except OSError as error:
        raise InputError(f"{path} cannot be written: {error.strerror or error}; name another place") from error
