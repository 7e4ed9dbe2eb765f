"""A data set on disk: images, masks, known background images, a manifest with one line per frame; a contact sheet."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.datasets.samples import render_samples, unit_blocks
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
    draw = partial(_rendered, split=split, backgrounds=backgrounds)
    with DataSetWriter(out_dir) as writer:
        for frames in each(draw, unit_blocks(seed, count), workers, named=_block_name):
            for frame in frames:
                writer.add(*frame)
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

    def add(self, source: dict[str, Any], mask: Image, files: Files) -> None:
        """Write one frame under the next number: its files, its mask (0 or 1), and its manifest line.

        The line has the file name, `source`, whether there is contact, and its share of the image.
        """
        name, share = f"{self.written:06d}.png", float(mask.mean())
        line = {"file": name, **source, "has_contact": share > 0.0, "contact_share": round(share, 5)}
        try:
            for kind, data in {**files, MASKS: png(mask * np.uint8(255))}.items():
                (self._out_dir / kind).mkdir(exist_ok=True)
                (self._out_dir / kind / name).write_bytes(data)
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


def labeled_frames(folder: Path, most: int | None = None) -> Iterator[tuple[Image, Image | None, NDArray[np.bool_]]]:
    """Yield image, background image (None if the data set has none) and mask of every frame. Raises InputError.

    Args:
        most: yield at most so many frames, spread over the data set.
    """
    pairs = data_set_pairs(folder)
    count = min(len(pairs), most or len(pairs))
    for image, mask in (pairs[k * len(pairs) // count] for k in range(count)):
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
    block: range, split: str, backgrounds: Sequence[Image] | None
) -> list[tuple[dict[str, Any], Image, Files]]:
    out = []
    for seed, rendered in zip(block, render_samples(block, backgrounds, split), strict=True):
        pose = asdict(rendered.view)
        source = {"seed": seed, "split": split, "object": pose.pop("object_name"), "label": LABEL_NAME}
        del pose["effects"]  # training frames have none
        source |= {key: round(value, 4) for key, value in pose.items()}
        files = {IMAGES: png(rendered.image), BACKGROUNDS: png(rendered.background)}
        out.append((source, label(rendered.truth), files))
    return out


def _block_name(block: range) -> str:
    return f"seeds {block.start} to {block.stop - 1}"


def _unwritable(folder: Path, error: OSError) -> InputError:
    return InputError(f"{folder}: cannot be written ({error.strerror or error}); choose another folder")


SHEET_COLUMNS, SHEET_FRAMES = 10, 30
TILE_PX = (120, 160)


def contact_sheet(folder: Path, target: Path) -> None:
    """Write one PNG of up to 30 frames: each image, below it with its label, below that its difference if known.

    The difference is to the background image. Raises InputError if `folder` has no data set or `target` cannot be
    written.
    """
    frames = list(labeled_frames(folder, SHEET_FRAMES))
    tiles = [_tile(*frame) for frame in frames]
    columns = min(SHEET_COLUMNS, len(tiles))
    tiles += [np.zeros_like(tiles[0])] * (-len(tiles) % columns)
    rows = [np.hstack(tiles[k : k + columns]) for k in range(0, len(tiles), columns)]
    try:
        target.write_bytes(png(np.asarray(np.vstack(rows), np.uint8)))
    except OSError as error:
        raise InputError(f"{target}: cannot be written ({error.strerror or error}); choose another path") from error


def _tile(image: Image, background: Image | None, mask: NDArray[np.bool_]) -> Image:
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    outlined = cv2.drawContours(image.copy(), contours, -1, (255, 255, 255), 2)
    gray = np.full_like(image, 128)
    change = gray if background is None else np.clip(image.astype(np.int16) - background + 128, 0, 255)
    parts = [np.asarray(cv2.resize(np.asarray(one, np.uint8), TILE_PX)) for one in (image, outlined, change)]
    return np.asarray(np.vstack(parts), np.uint8)
