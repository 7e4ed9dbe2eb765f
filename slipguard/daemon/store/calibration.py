"""Each finger's no-contact image and noise: what `slipguard calibrate` stores, by serial."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from slipguard.devices import Frame
from slipguard.errors import CommandRefused

FRAMES = 30
"""Half a second at 60 fps: averages the noise to a fifth, and a passing touch shows."""
TIMEOUT_S = 5.0
NOISE_MAX = 8.0
"""Grey levels; a still DIGIT has 1.5 to 2.9. More means that something moves."""
CHANGE_MAX = 4.0
"""Grey levels between beginning, middle and end, mean of a block; noise leaves 0.1. More means that something came."""
BLOCK_PX = 20


@dataclass(frozen=True, slots=True, eq=False)
class BackgroundImage:
    """image: (320, 240, 3) uint8 BGR, mean of the frames. noise_bgr: standard deviation over time of one pixel."""

    image: NDArray[np.uint8]
    noise_bgr: tuple[float, float, float]
    frames: int


@dataclass(frozen=True, slots=True)
class BackgroundVersion:
    """One stored no-contact image. created_at: when it was taken. level_bgr: its mean; None in older files.

    new_gel: the first one of a gel. copy_of: the number it was fetched back from.
    """

    number: int
    created_at: datetime
    noise_bgr: tuple[float, float, float]
    level_bgr: tuple[float, float, float] | None
    frames: int
    new_gel: bool
    copy_of: int | None


class Store(Protocol):
    """Where no-contact images are kept, by serial."""

    def load_background(self, serial: str) -> BackgroundImage | None: ...

    def save_background(self, serial: str, taken: BackgroundImage) -> None: ...


@runtime_checkable
class BackgroundArchive(Protocol):
    """A store that keeps the older ones, too; see `slipguard.daemon.store.state_dir`."""

    def load_background(self, serial: str, number: int | None = None) -> BackgroundImage | None: ...

    def first_of_gel(self, serial: str) -> BackgroundImage | None: ...

    def save_background(self, serial: str, taken: BackgroundImage, *, new_gel: bool = False) -> None: ...

    def go_back(self, serial: str, number: int) -> BackgroundImage: ...

    def background_versions(self, serial: str) -> Sequence[BackgroundVersion]: ...


def average_background(images: Sequence[NDArray[np.uint8]], finger: str) -> BackgroundImage:
    """Average frames (each (320, 240, 3) uint8 BGR) of an untouched gel.

    Raises CommandRefused where the pictures are not still.
    """
    stack = np.stack(images).astype(np.float32)
    mean = stack.mean(axis=0)
    # Neighbouring frames differ by the noise alone, whatever the light slowly does.
    noise = np.diff(stack, axis=0).std(axis=(0, 1, 2)) / np.sqrt(2.0)
    if noise.max() > NOISE_MAX:
        raise CommandRefused(
            f"{finger}: the picture is not still (noise {noise.max():.1f} grey levels, at most {NOISE_MAX:g}); "
            "keep the jaws open, empty and at rest, and try again"
        )
    change = _change(stack)
    if change > CHANGE_MAX:
        raise CommandRefused(
            f"{finger}: something touched the gel (the picture changed by {change:.0f} grey levels, "
            f"at most {CHANGE_MAX:g}); keep the jaws open, empty and at rest, and try again"
        )
    image = np.clip(np.rint(mean), 0, 255).astype(np.uint8)
    image.setflags(write=False)
    return BackgroundImage(image, (float(noise[0]), float(noise[1]), float(noise[2])), len(images))


def _change(stack: NDArray[np.float32]) -> float:
    """Largest difference of a block's mean among beginning, middle and end of the frames, in grey levels."""
    thirds = np.stack([part.mean(axis=0) for part in np.array_split(stack, 3)])
    rows, columns = (size // BLOCK_PX for size in thirds.shape[1:3])
    whole = thirds[:, : rows * BLOCK_PX, : columns * BLOCK_PX]
    blocks = whole.reshape(3, rows, BLOCK_PX, columns, BLOCK_PX, -1).mean(axis=(2, 4))
    return float(np.ptp(blocks, axis=0).max())


async def collect(tap: asyncio.Queue[Frame], finger: str) -> list[NDArray[np.uint8]]:
    """The next FRAMES images of a sensor; raises CommandRefused when they do not come."""
    images: list[NDArray[np.uint8]] = []
    try:
        async with asyncio.timeout(TIMEOUT_S):
            while len(images) < FRAMES:
                images.append((await tap.get()).image)
    except TimeoutError:
        raise CommandRefused(
            f"{finger}: only {len(images)} of {FRAMES} frames came within {TIMEOUT_S:g} s; check the sensor"
        ) from None
    return images
