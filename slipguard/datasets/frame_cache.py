"""Rendered frames on disk, at network resolution, so that training can be stopped, resumed and repeated."""

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

from slipguard.datasets.samples import render_sample
from slipguard.perception.contact.segmenter import INPUT_HEIGHT_PX, INPUT_WIDTH_PX
from slipguard.sim.contact_label import LABEL_NAME, label

CHUNK = 200
VALIDATION_SEED = 1_000_000_000
"""Validation frames count their seeds from here: no training run reaches it."""


@dataclass(frozen=True, slots=True, eq=False)
class RenderedFrames:
    """Memory-mapped arrays. frame, background: (N, 160, 120, 3) uint8; label: (N, 160, 120) uint8, 255 is contact."""

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
) -> RenderedFrames:
    """Frames `first_seed` to `first_seed + count`, from the cache in `work` as far as they are there.

    `progress` is called with the number of frames ready. What was drawn before an interruption is kept.
    """
    folder = work / f"frames-{_key(first_seed, count)}"
    folder.mkdir(parents=True, exist_ok=True)
    note = folder / "ready.json"
    ready = json.loads(note.read_text())["ready"] if note.is_file() else 0
    image_shape = (count, INPUT_HEIGHT_PX, INPUT_WIDTH_PX, 3)
    mode = "r+" if ready else "w+"
    frame = _array(folder / "frame.npy", mode, image_shape)
    background = _array(folder / "background.npy", mode, image_shape)
    labels = _array(folder / "label.npy", mode, image_shape[:3])
    progress(ready)
    while ready < count:
        upto = min(ready + CHUNK, count)
        for index in range(ready, upto):
            drawn = render_sample(first_seed + index)
            frame[index] = _halved(drawn.image)
            background[index] = _halved(drawn.background)
            labels[index] = _halved(label(drawn.truth) * np.uint8(255))
        for array in (frame, background, labels):
            array.flush()
        ready = upto
        note.write_text(json.dumps({"ready": ready}))
        progress(ready)
    return RenderedFrames(frame, background, labels)


def _key(first_seed: int, count: int) -> str:
    return hashlib.sha256(f"{first_seed} {count} {LABEL_NAME}".encode()).hexdigest()[:12]


def _array(path: Path, mode: Any, shape: tuple[int, ...]) -> np.memmap[Any, np.dtype[np.uint8]]:
    return np.lib.format.open_memmap(path, mode=mode, dtype=np.uint8, shape=shape)


def _halved(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    size = (INPUT_WIDTH_PX, INPUT_HEIGHT_PX)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
