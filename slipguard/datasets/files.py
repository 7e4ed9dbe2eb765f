"""A data set on disk: images, masks, no-contact images where they are known, and a manifest of one line a frame."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.datasets.samples import UNIT_FRAMES, RenderedSample, render_sample
from slipguard.errors import InputError
from slipguard.sim.contact_label import LABEL_NAME, label
from slipguard.sim.sensor_unit import FRAME_HEIGHT_PX, FRAME_WIDTH_PX
from slipguard.tools.parallel import Workers, each

Image = NDArray[np.uint8]
Files = dict[str, bytes]
"""One frame's PNG files by the folder they belong to."""
IMAGES, BACKGROUNDS, MASKS = "images", "backgrounds", "masks"
MANIFEST_NAME = "manifest.jsonl"
IMAGE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".bmp"})


def check_new(out_dir: Path) -> None:
    """Raise InputError where `out_dir` is neither new nor an empty folder."""
    if out_dir.exists() and (not out_dir.is_dir() or any(out_dir.iterdir())):
        raise InputError(f"{out_dir} exists and is not an empty folder; name a new one")


def check_request(out_dir: Path, count: int, seed: int, split: str) -> None:
    """Raise the InputError that `render_dataset` would raise before it writes anything."""
    if count < 1:
        raise InputError(f"{count} frames cannot be rendered; give a count of at least 1")
    if seed < 0:
        raise InputError(f"seed {seed} is negative; give 0 or more")
    if split not in ("train", "test"):
        raise InputError(f"no split {split!r}; there are: train, test")
    check_new(out_dir)


def render_dataset(
    out_dir: Path,
    count: int,
    seed: int = 0,
    split: str = "train",
    backgrounds: Sequence[Image] | None = None,
    progress: Callable[[int], None] = lambda done: None,
    workers: Workers | None = None,
) -> None:
    """Write `count` frames, seeds `seed` onwards, into a new or empty folder; the same whoever computes them.

    images/, backgrounds/ and masks/ hold PNGs of one name, 240 wide x 320 high; masks are 0 or 255. manifest.jsonl has
    one line a frame: file, seed, split, object, has_contact, pose, share of the frame that is contact, name of the
    label. progress is called with the number of frames written. Raises InputError for a count that is not positive, a
    negative seed, an unknown split, a folder with something in it, or one that cannot be written.
    """
    check_request(out_dir, count, seed, split)
    seeds = range(seed, seed + count)
    edges = [seed, *range((seed // UNIT_FRAMES + 1) * UNIT_FRAMES, seed + count, UNIT_FRAMES), seed + count]
    blocks = [seeds[a - seed : b - seed] for a, b in pairwise(edges)]
    draw = partial(_drawn, first_seed=seed, split=split, backgrounds=backgrounds)
    with DataSetWriter(out_dir) as writer:
        for frames in each(draw, blocks, workers, named=_named):
            for line, files in frames:
                writer.add(line, files)
                progress(writer.written)


class DataSetWriter:
    """Writes frame after frame into a new folder; a context, which closes the manifest at its end.

    An InputError passing through it, or a full disk, takes the folder's contents with it; an interruption leaves what
    is written, which is a whole data set of fewer frames. Raises InputError where the folder cannot be written.
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
        except OSError as error:  # its last lines found no room
            unwritten = error
        if unwritten is not None or (kind is not None and issubclass(kind, InputError)):
            for folder in (IMAGES, BACKGROUNDS, MASKS):
                shutil.rmtree(self._out_dir / folder, ignore_errors=True)
            (self._out_dir / MANIFEST_NAME).unlink(missing_ok=True)
        if unwritten is not None and kind is None:
            raise _unwritable(self._out_dir, unwritten) from unwritten

    def add(self, line: dict[str, Any], files: Files) -> None:
        """Write one frame's files under the name in line["file"], and its line of the manifest."""
        try:
            for kind, data in files.items():
                (self._out_dir / kind).mkdir(exist_ok=True)
                (self._out_dir / kind / line["file"]).write_bytes(data)
            self._manifest.write(json.dumps(line) + "\n")
        except OSError as error:
            raise _unwritable(self._out_dir, error) from error
        self.written += 1


def data_set_pairs(folder: Path) -> list[tuple[Path, Path]]:
    """(image, mask) of every frame, by name. Raises InputError where there is no data set, or a mask is missing."""
    images = sorted((folder / IMAGES).glob("*.png"))
    if not images:
        raise InputError(
            f"{folder} holds no data set (images/*.png); render one, or import one, with slipguard dataset"
        )
    pairs = [(image, folder / MASKS / image.name) for image in images]
    missing = [mask for _, mask in pairs if not mask.is_file()]
    if missing:
        raise InputError(f"{missing[0]} is missing ({len(missing)} of {len(pairs)} masks are); import the images again")
    return pairs


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
    return [read_background(path) for path in paths]


def read_background(path: Path) -> Image:
    """A no-contact image, (320, 240, 3) uint8 BGR. Raises InputError for what cannot be read or has another size."""
    image = read_colour(path)
    height, width = image.shape[:2]
    if (height, width) != (FRAME_HEIGHT_PX, FRAME_WIDTH_PX):
        allowed = f"{FRAME_WIDTH_PX} wide x {FRAME_HEIGHT_PX} high"
        raise InputError(f"{path}: {width} wide x {height} high; a no-contact image is {allowed}")
    return image


def read_colour(path: Path) -> Image:
    """The picture of a file, (H, W, 3) uint8 BGR. Raises InputError for what cannot be read."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror or error}") from error
    image = cv2.imdecode(np.frombuffer(data or b"\0", np.uint8), cv2.IMREAD_COLOR)
    if image is None:
        raise InputError(f"{path}: not an image that can be read; remove it or replace it")
    return np.asarray(image, np.uint8)


def png(image: Image) -> bytes:
    """The picture as the bytes of a PNG file."""
    _, data = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 3])
    return data.tobytes()


def _drawn(
    block: range, first_seed: int, split: str, backgrounds: Sequence[Image] | None
) -> list[tuple[dict[str, Any], Files]]:
    out = []
    for seed in block:
        drawn = render_sample(seed, backgrounds, split)
        mask = label(drawn.truth)
        files = {IMAGES: png(drawn.image), BACKGROUNDS: png(drawn.background), MASKS: png(mask * np.uint8(255))}
        out.append((_line(f"{seed - first_seed:06d}.png", seed, split, drawn, mask), files))
    return out


def _named(block: range) -> str:
    return f"seeds {block.start} to {block.stop - 1}"


def _line(name: str, seed: int, split: str, drawn: RenderedSample, mask: Image) -> dict[str, Any]:
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


def _unwritable(folder: Path, error: OSError) -> InputError:
    return InputError(f"{folder} cannot be written: {error.strerror or error}; name another folder")
