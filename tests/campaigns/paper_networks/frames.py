"""Frames with masks for the paper's networks: rendered, as many as in the paper, or from a data set's folder."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.datasets.dataset_files import data_set_pairs
from slipguard.datasets.samples import UNIT_FRAMES, press_of
from slipguard.errors import InputError
from slipguard.sim.contact_label import LABEL_NAME, label
from slipguard.tools.image_files import read_bgr
from slipguard.tools.parallel import Workers, each

Image = NDArray[np.uint8]
OBJECTS = (
    "banana", "battery", "bead", "bolt", "bottle", "bracket", "clover", "coin",
    "cross", "egg", "gear", "hammer", "nut", "pen", "rod", "spring",
)  # fmt: skip
"""Sixteen training objects, closest to the household objects of the paper; frames cycle through them."""
HELD_OUT_SEED = 1_000_000_000


@dataclass(frozen=True, slots=True, eq=False)
class MaskedFrames:
    """frame: (N, H, W, 3) uint8 BGR; mask: (N, H, W) uint8, 128 and above is contact."""

    frame: Image
    mask: Image

    def __len__(self) -> int:
        return len(self.frame)

    def sample(self, count: int) -> Iterator[dict[str, Image]]:
        """Return about `count` evenly spaced frames as inputs of a network."""
        step = len(self) // min(count, len(self))
        return ({"frame": np.array(self.frame[index : index + 1])} for index in range(0, len(self), step))


def render_masked_frames(
    work: Path,
    count: int,
    size_px: tuple[int, int],
    held_out: bool = False,
    workers: Workers | None = None,
    progress: Callable[[int], None] = lambda done: None,
) -> MaskedFrames:
    """Render frames of `OBJECTS` into memory-mapped files; frames rendered before an interruption are kept.

    Args:
        work: Folder of the files.
        count: Number of frames.
        size_px: (width, height) of the frames.
        held_out: Use seeds and sensor units that are not used for training.
        workers: Processes to render in.
        progress: Called with the number of finished frames.
    """
    key = hashlib.sha256(f"{OBJECTS} {count} {size_px} {held_out} {LABEL_NAME}".encode()).hexdigest()[:12]
    folder = work / f"masked-{key}"
    folder.mkdir(parents=True, exist_ok=True)
    note = folder / "ready.json"
    ready = int(json.loads(note.read_text())["ready"]) if note.is_file() else 0
    width, height = size_px
    frame = _array(folder / "frame.npy", ready > 0, (count, height, width, 3))
    mask = _array(folder / "mask.npy", ready > 0, (count, height, width))
    progress(ready)
    blocks = [range(at, min(at + UNIT_FRAMES, count)) for at in range(ready, count, UNIT_FRAMES)]
    first_seed = HELD_OUT_SEED if held_out else 0
    draw = partial(_render_block, first_seed=first_seed, size_px=size_px)
    for block, (images, masks) in zip(blocks, each(draw, blocks, workers, named=_block_name), strict=True):
        frame[block.start : block.stop], mask[block.start : block.stop] = images, masks
        frame.flush()
        mask.flush()
        note.write_text(json.dumps({"ready": block.stop}))
        progress(block.stop)
    return MaskedFrames(frame, mask)


def read_masked_frames(folder: Path, size_px: tuple[int, int]) -> tuple[MaskedFrames, MaskedFrames]:
    """Read frames and masks of a data set (images/, masks/), for training and held out.

    Held out is the last tenth by name, at least one frame, so that neighbors in a recording stay together.

    Args:
        folder: The data set.
        size_px: (width, height) of the frames.

    Raises:
        InputError: The folder contains no data set, or fewer than two frames.
    """
    pairs = data_set_pairs(folder)
    if len(pairs) < 2:
        raise InputError(f"{folder} contains one frame, minimum 2: one is held out. Add frames.")
    images = np.stack([resized(read_bgr(image), size_px) for image, _ in pairs])
    masks = np.stack([resized(read_bgr(mask)[..., 0], size_px) for _, mask in pairs])
    split = len(pairs) - max(len(pairs) // 10, 1)
    return MaskedFrames(images[:split], masks[:split]), MaskedFrames(images[split:], masks[split:])


def resized(image: Image, size_px: tuple[int, int]) -> Image:
    """Return the image at (width, height) `size_px`; areas are averaged when it shrinks."""
    if image.shape[1::-1] == size_px:
        return image
    method = cv2.INTER_AREA if image.shape[1] > size_px[0] else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(image, size_px, interpolation=method), np.uint8)


def _render_block(block: range, first_seed: int, size_px: tuple[int, int]) -> tuple[Image, Image]:
    images, masks = [], []
    for index in block:
        shown = press_of(OBJECTS[index % len(OBJECTS)], first_seed + index)
        images.append(resized(shown.image, size_px))
        masks.append(resized(label(shown.truth) * np.uint8(255), size_px))
    return np.stack(images), np.stack(masks)


def _block_name(block: range) -> str:
    return f"frames {block.start} to {block.stop - 1}"


def _array(path: Path, exists: bool, shape: tuple[int, ...]) -> np.memmap[Any, np.dtype[np.uint8]]:
    mode: Any = "r+" if exists else "w+"
    return np.lib.format.open_memmap(path, mode=mode, dtype=np.uint8, shape=shape)
