"""Rendered frames stored at full resolution with their truth, so that labels and resolutions share the same frames."""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.datasets.frame_cache import VALIDATION_SEED, TrainingFrames
from slipguard.datasets.samples import RenderedSample, press_of, render_sample
from slipguard.devices import FRAME_HEIGHT_PX, FRAME_WIDTH_PX
from slipguard.sim.contact_label import closed_region, label
from slipguard.sim.gel_camera import GelTruth

HELD_OUT = ("battery", "bolt", "coin", "cone", "egg", "gear", "pen", "tee")
"""Training objects left out of these trainings; the variants are scored on them."""
CONTACT = "contact"


@dataclass(frozen=True, slots=True, eq=False)
class StoredFrames:
    """N rendered frames with their truth.

    Attributes:
        frame, background: (N, 320, 240, 3) uint8.
        moved_mm: (N, 320, 240) float16, gel displacement.
        touching: (N, 320, 240) bool, contact.
        press_mm: (N,) float32, indentation.
    """

    frame: NDArray[np.uint8]
    background: NDArray[np.uint8]
    moved_mm: NDArray[np.float16]
    touching: NDArray[np.bool_]
    press_mm: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.frame)

    def masks(self, wanted: float | str) -> NDArray[np.uint8]:
        """Return labels (N, 320, 240) uint8, 0 or 1, for a share of the deepest press, or for `CONTACT`."""
        out = np.zeros(self.touching.shape, np.uint8)
        for index in range(len(self)):
            if isinstance(wanted, str):
                out[index] = closed_region(self.touching[index])
            else:
                moved_mm = self.moved_mm[index].astype(np.float32)
                press_mm = float(self.press_mm[index])
                out[index] = label(GelTruth(self.frame[index], self.touching[index], moved_mm, press_mm), wanted)
        return out

    def first(self, count: int) -> StoredFrames:
        """Return the first `count` frames."""
        return StoredFrames(*(getattr(self, name)[:count] for name in self.__slots__))

    def at(self, size: tuple[int, int], masks: NDArray[np.uint8]) -> TrainingFrames:
        """Return frames and labels, area-averaged to (width, height)."""
        return TrainingFrames(*(_smaller(a, size) for a in (self.frame, self.background, masks * np.uint8(255))))


def training_frames(work: Path, count: int, progress: Callable[[int], None]) -> StoredFrames:
    """Return `count` frames of the training distribution without the `HELD_OUT` objects, stored in `work`."""
    every = (render_sample(seed) for seed in itertools.count())
    return _stored(work / f"drawn-{count}", (s for s in every if s.view.object_name not in HELD_OUT), count, progress)


def held_out_frames(work: Path, count: int, progress: Callable[[int], None]) -> StoredFrames:
    """Return `count` presses of the `HELD_OUT` objects, stored in `work`."""
    presses = (press_of(HELD_OUT[n % len(HELD_OUT)], VALIDATION_SEED + n) for n in itertools.count())
    return _stored(work / f"held-out-{count}", presses, count, progress)


def _stored(
    folder: Path, samples: Iterator[RenderedSample], count: int, progress: Callable[[int], None]
) -> StoredFrames:
    folder.mkdir(parents=True, exist_ok=True)
    note = folder / "done.json"
    done = note.is_file()
    plane = (count, FRAME_HEIGHT_PX, FRAME_WIDTH_PX)
    wanted = {
        "frame": (np.uint8, (*plane, 3)),
        "background": (np.uint8, (*plane, 3)),
        "moved": (np.float16, plane),
        "touching": (np.bool_, plane),
        "press": (np.float32, (count,)),
    }
    mode: Any = "r" if done else "w+"
    parts: list[Any] = [
        np.lib.format.open_memmap(folder / f"{name}.npy", mode, dtype, shape) for name, (dtype, shape) in wanted.items()
    ]
    for index, drawn in enumerate(itertools.islice(samples, 0 if done else count)):
        truth = drawn.truth
        values = (drawn.image, drawn.background, truth.displacement_mm, truth.contact, truth.press_mm)
        for part, value in zip(parts, values, strict=True):
            part[index] = value
        progress(index + 1)
    note.write_text(json.dumps({"frames": count}))
    return StoredFrames(*parts)


def _smaller(images: NDArray[np.uint8], size: tuple[int, int]) -> NDArray[np.uint8]:
    return np.stack([np.asarray(cv2.resize(i, size, interpolation=cv2.INTER_AREA), np.uint8) for i in images])
