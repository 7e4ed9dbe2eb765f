"""Frames for training at network resolution: rendered ones, kept on disk for a later run, or those of a data set."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.datasets.dataset_files import labeled_frames
from slipguard.datasets.samples import render_sample
from slipguard.errors import InputError
from slipguard.perception.background import estimate_background
from slipguard.perception.segmenter import INPUT_HEIGHT_PX, INPUT_WIDTH_PX
from slipguard.sim.contact_label import LABEL_NAME, label

CHUNK = 200
VALIDATION_SEED = 1_000_000_000
"""First seed of the validation frames, beyond all training seeds."""


@dataclass(frozen=True, slots=True, eq=False)
class TrainingFrames:
    """frame, background: (N, 160, 120, 3) uint8; label: (N, 160, 120) uint8, 255 is contact."""

    frame: NDArray[np.uint8]
    background: NDArray[np.uint8]
    label: NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.frame)


def rendered_frames(
    work: Path,
    first_seed: int,
    count: int,
    progress: Callable[[int], None],
) -> TrainingFrames:
    """Return the frames of `count` seeds from `first_seed` on, from the cache in `work` if available.

    `progress` is called with the number of frames ready. Frames rendered before an interruption are kept.
    """
    folder = work / f"frames-{_key(first_seed, count)}"
    folder.mkdir(parents=True, exist_ok=True)
    progress_file = folder / "ready.json"
    ready = json.loads(progress_file.read_text())["ready"] if progress_file.is_file() else 0
    image_shape = (count, INPUT_HEIGHT_PX, INPUT_WIDTH_PX, 3)
    mode = "r+" if ready else "w+"
    frame = _array(folder / "frame.npy", mode, image_shape)
    background = _array(folder / "background.npy", mode, image_shape)
    labels = _array(folder / "label.npy", mode, image_shape[:3])
    progress(ready)
    while ready < count:
        chunk_end = min(ready + CHUNK, count)
        for index in range(ready, chunk_end):
            rendered = render_sample(first_seed + index)
            frame[index] = _at_network_size(rendered.image)
            background[index] = _at_network_size(rendered.background)
            labels[index] = _at_network_size(label(rendered.truth) * np.uint8(255))
        for array in (frame, background, labels):
            array.flush()
        ready = chunk_end
        progress_file.write_text(json.dumps({"ready": ready}))
        progress(ready)
    return TrainingFrames(frame, background, labels)


def read_frames(folder: Path) -> tuple[TrainingFrames, TrainingFrames]:
    """Return the frames of a data set, for training and held out. Missing background images are estimated.

    Held out is the last tenth by name, at least one frame, so that neighbors in a recording stay together.

    Raises:
        InputError: If the folder contains no data set, or fewer than two frames.
    """
    rows = []
    for image, background, mask in labeled_frames(folder):
        frame = _at_network_size(image)
        shown = estimate_background(frame) if background is None else _at_network_size(background)
        rows.append((frame, shown, _at_network_size(mask * np.uint8(255))))
    if len(rows) < 2:
        raise InputError(f"{folder} contains one frame, minimum 2: one is held out. Add frames.")
    arrays = [np.stack(column) for column in zip(*rows, strict=True)]
    split = len(rows) - max(len(rows) // 10, 1)
    return TrainingFrames(*(one[:split] for one in arrays)), TrainingFrames(*(one[split:] for one in arrays))


def _key(first_seed: int, count: int) -> str:
    return hashlib.sha256(f"{first_seed} {count} {LABEL_NAME}".encode()).hexdigest()[:12]


def _array(path: Path, mode: Any, shape: tuple[int, ...]) -> np.memmap[Any, np.dtype[np.uint8]]:
    return np.lib.format.open_memmap(path, mode=mode, dtype=np.uint8, shape=shape)


def _at_network_size(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    size = (INPUT_WIDTH_PX, INPUT_HEIGHT_PX)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
