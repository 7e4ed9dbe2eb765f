"""A data set on disk: images, masks, known background images, a manifest with one line per frame; a contact sheet."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.datasets.samples import UNIT_FRAMES, RenderedSample, render_sample
from slipguard.devices import FRAME_HEIGHT_PX, FRAME_WIDTH_PX
from slipguard.errors import InputError
from slipguard.sim.contact_label import LABEL_NAME, label
from slipguard.tools.image_files import IMAGE_ENDINGS, read_bgr
from slipguard.tools.parallel import Workers, each

Image = NDArray[np.uint8]
Files = dict[str, bytes]
"""One frame's PNG files by folder."""
IMAGES, BACKGROUNDS, MASKS = "images", "backgrounds", "masks"
MANIFEST_NAME = "manifest.jsonl"
IMPORTED_LABEL = "imported"
"""What the masks of an imported data set mean: only their author knows."""


def check_new(out_dir: Path) -> None:
    """Raise InputError if `out_dir` is neither new nor an empty folder."""
    if out_dir.exists() and (not out_dir.is_dir() or any(out_dir.iterdir())):
        raise InputError(f"{out_dir}: exists and is not an empty folder; choose a new one")


def render_dataset(
    out_dir: Path,
    count: int,
    seed: int = 0,
    split: str = "train",
    backgrounds: Sequence[Image] | None = None,
    progress: Callable[[int], None] = lambda done: None,
    workers: Workers | None = None,
) -> None:
    """Write `count` frames, with seeds from `seed` on, into a new or empty folder; independent of the workers.

    images/, backgrounds/ and masks/ hold PNGs of the same name, 240 wide x 320 high; masks are 0 or 255. manifest.jsonl
    has one line per frame: file, seed, split, object, has_contact, pose, contact area as a share, name of the label.

    Args:
        progress: called with the number of frames written.

    Raises:
        InputError: the folder is not empty or cannot be written.
    """
    check_new(out_dir)
    seeds = range(seed, seed + count)
    edges = [seed, *range((seed // UNIT_FRAMES + 1) * UNIT_FRAMES, seed + count, UNIT_FRAMES), seed + count]
    blocks = [seeds[a - seed : b - seed] for a, b in pairwise(edges)]
    draw = partial(_rendered, first_seed=seed, split=split, backgrounds=backgrounds)
    with DataSetWriter(out_dir) as writer:
        for frames in each(draw, blocks, workers, named=_block_name):
            for line, files in frames:
                writer.add(line, files)
                progress(writer.written)


class DataSetWriter:
    """Writes frames into a new folder; a context manager that closes the manifest.

    After an InputError or a full disk the folder's contents are deleted. After an interruption the frames written so
    far remain, as a complete smaller data set. Raises InputError if the folder cannot be written.
    """

    def __init__(self, out_dir: Path) -> None:
        self._out_dir = out_dir
        self.written = 0
        try:
            out_dir.mkdir(parents=True, exist_ok=True)
            self._manifest = (out_dir / MANIFEST_NAME).open("w", encoding="utf-8")
        except OSError as error:
            raise _unwritable(out_dir, error) from error

    def __enter__(self) -> DataSetWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, *failure: object) -> None:
        unwritten: OSError | None = None
        try:
            self._manifest.close()
        except OSError as error:  # no space for its last lines
            unwritten = error
        if unwritten is not None or (kind is not None and issubclass(kind, InputError)):
            for folder in (IMAGES, BACKGROUNDS, MASKS):
                shutil.rmtree(self._out_dir / folder, ignore_errors=True)
            (self._out_dir / MANIFEST_NAME).unlink(missing_ok=True)
        if unwritten is not None and kind is None:
            raise _unwritable(self._out_dir, unwritten) from unwritten

    def add(self, line: dict[str, Any], files: Files) -> None:
        """Write one frame's files under the name in line["file"], and its manifest line."""
        try:
            for kind, data in files.items():
                (self._out_dir / kind).mkdir(exist_ok=True)
                (self._out_dir / kind / line["file"]).write_bytes(data)
            self._manifest.write(json.dumps(line) + "\n")
        except OSError as error:
            raise _unwritable(self._out_dir, error) from error
        self.written += 1


def data_set_pairs(folder: Path) -> list[tuple[Path, Path]]:
    """Return (image, mask) of every frame. Raises InputError if there is no data set or a mask is missing."""
    images = sorted((folder / IMAGES).glob("*.png"))
    if not images:
        raise InputError(f"{folder}: no data set (images/*.png); render or import one with `slipguard dataset`")
    pairs = [(image, folder / MASKS / image.name) for image in images]
    missing = [mask for _, mask in pairs if not mask.is_file()]
    if missing:
        raise InputError(f"{missing[0]}: missing ({len(missing)} of {len(pairs)} masks); import the images again")
    return pairs


def labeled_frames(folder: Path) -> Iterator[tuple[Image, Image | None, NDArray[np.bool_]]]:
    """Yield image, background image (None if the data set has none) and mask of every frame. Raises InputError."""
    for image, mask in data_set_pairs(folder):
        background = folder / BACKGROUNDS / image.name
        yield read_bgr(image), read_bgr(background) if background.is_file() else None, read_bgr(mask)[..., 0] > 127


def read_backgrounds(folder: Path) -> list[Image]:
    """Return the background images of a folder, sorted by name, each (320, 240, 3) uint8 BGR.

    Raises InputError for a missing folder, one without images, and an image that cannot be read or has another size.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: not a folder; name one with background images")
    paths = sorted(path for path in folder.iterdir() if path.suffix.lower() in IMAGE_ENDINGS)
    if not paths:
        raise InputError(
            f"{folder}: no image ({', '.join(sorted(IMAGE_ENDINGS))}); name a folder with background images"
        )
    return [read_background(path) for path in paths]


def read_background(path: Path) -> Image:
    """Return a background image, (320, 240, 3) uint8 BGR. Raises InputError if unreadable or of another size."""
    image = read_bgr(path)
    height, width = image.shape[:2]
    if (height, width) != (FRAME_HEIGHT_PX, FRAME_WIDTH_PX):
        allowed = f"{FRAME_WIDTH_PX} wide x {FRAME_HEIGHT_PX} high"
        raise InputError(f"{path}: {width} wide x {height} high; a background image is {allowed}")
    return image


def png(image: Image) -> bytes:
    _, data = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 3])
    return data.tobytes()


def _rendered(
    block: range, first_seed: int, split: str, backgrounds: Sequence[Image] | None
) -> list[tuple[dict[str, Any], Files]]:
    out = []
    for seed in block:
        rendered = render_sample(seed, backgrounds, split)
        mask = label(rendered.truth)
        files = {IMAGES: png(rendered.image), BACKGROUNDS: png(rendered.background), MASKS: png(mask * np.uint8(255))}
        out.append((_line(f"{seed - first_seed:06d}.png", seed, split, rendered, mask), files))
    return out


def _block_name(block: range) -> str:
    return f"seeds {block.start} to {block.stop - 1}"


def _line(name: str, seed: int, split: str, rendered: RenderedSample, mask: Image) -> dict[str, Any]:
    pose = asdict(rendered.view)
    del pose["effects"]  # training frames have none
    return {
        "file": name,
        "seed": seed,
        "split": split,
        "object": pose.pop("object_name"),
        "has_contact": rendered.has_contact,
        "contact_share": round(float(mask.mean()), 5),
        "label": LABEL_NAME,
        **{key: round(value, 4) for key, value in pose.items()},
    }


def _unwritable(folder: Path, error: OSError) -> InputError:
    return InputError(f"{folder}: cannot be written ({error.strerror or error}); choose another folder")


COLUMNS, ROWS = 10, 3
TILE_PX = (120, 160)
_TINT_BGR = (0, 200, 255)


def contact_sheet(folder: Path, target: Path) -> None:
    """Write one PNG of up to 30 frames: each image, below it with its label, below that its difference if known.

    The difference is to the background image. Raises InputError if `folder` has no data set or `target` cannot be
    written.
    """
    pairs = data_set_pairs(folder)
    count = min(len(pairs), COLUMNS * ROWS)
    tiles = [_tile(folder, *pairs[k * len(pairs) // count]) for k in range(count)]
    columns = min(COLUMNS, count)
    tiles += [np.zeros_like(tiles[0])] * (-count % columns)
    rows = [np.hstack(tiles[k : k + columns]) for k in range(0, len(tiles), columns)]
    try:
        target.write_bytes(png(np.asarray(np.vstack(rows), np.uint8)))
    except OSError as error:
        raise InputError(f"{target}: cannot be written ({error.strerror or error}); choose another path") from error


def _tile(folder: Path, image_path: Path, mask_path: Path) -> Image:
    image = cv2.resize(read_bgr(image_path), TILE_PX, interpolation=cv2.INTER_AREA)
    mask = np.asarray(cv2.resize(read_bgr(mask_path)[..., 0], TILE_PX, interpolation=cv2.INTER_AREA) > 127)
    labeled = image.copy()
    labeled[mask] = (labeled[mask] * 0.65 + np.asarray(_TINT_BGR) * 0.35).astype(np.uint8)
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(labeled, contours, -1, (255, 255, 255), 1)
    parts = [image, labeled]
    background = folder / BACKGROUNDS / image_path.name
    if (folder / BACKGROUNDS).is_dir():
        under = cv2.resize(read_bgr(background), TILE_PX, interpolation=cv2.INTER_AREA)
        parts.append(np.clip(image.astype(np.int16) - under + 128, 0, 255).astype(np.uint8))
    tile = np.vstack(parts)
    tile[:, -1] = tile[-1] = 0
    return np.asarray(tile, np.uint8)
