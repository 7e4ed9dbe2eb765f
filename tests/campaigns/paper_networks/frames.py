"""Frames with masks for the paper's networks: rendered, as many as in the paper, or from a data set's folder."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.datasets.dataset_files import data_set_pairs
from slipguard.datasets.samples import render_presses, unit_blocks
from slipguard.errors import InputError
from slipguard.sim.contact_label import label
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


def render_masked_frames(
    count: int, size_px: tuple[int, int], held_out: bool, workers: Workers, progress: Callable[[int], None]
) -> MaskedFrames:
    """Render frames of `OBJECTS`.

    Args:
        count: Number of frames.
        size_px: (width, height) of the frames.
        held_out: Use seeds and sensor units that are not used for training.
        workers: Processes to render in.
        progress: Called with the number of finished frames.
    """
    width, height = size_px
    frames = MaskedFrames(np.empty((count, height, width, 3), np.uint8), np.empty((count, height, width), np.uint8))
    first_seed = HELD_OUT_SEED if held_out else 0
    blocks = unit_blocks(first_seed, count)
    for block, rendered in zip(blocks, each(partial(_render_block, size_px=size_px), blocks, workers), strict=True):
        part = slice(block.start - first_seed, block.stop - first_seed)
        frames.frame[part], frames.mask[part] = rendered
        progress(part.stop)
    return frames


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


def _render_block(seeds: range, size_px: tuple[int, int]) -> tuple[Image, Image]:
    presses = list(render_presses(OBJECTS, seeds))
    images = [resized(one.image, size_px) for one in presses]
    masks = [resized(label(one.truth) * np.uint8(255), size_px) for one in presses]
    return np.stack(images), np.stack(masks)
