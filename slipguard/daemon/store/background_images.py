"""Background images: what each sensor sees without contact, as `slipguard calibrate` takes and stores it."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from slipguard.devices import Frame
from slipguard.errors import CommandRefused
from slipguard.perception.image_quality import check_background

FRAMES = 30
"""Half a second at 60 fps: averaging reduces the noise to a fifth, and a brief touch is noticed."""
TIMEOUT_S = 5.0
NOISE_MAX = 8.0
"""Gray levels; a still DIGIT has 1.5 to 2.9. More means that something moves."""
CHANGE_MAX = 4.0
"""Gray levels, mean of a block, between beginning, middle and end; noise causes 0.1. More means a touch."""
BLOCK_PX = 20


@dataclass(frozen=True, slots=True, eq=False)
class BackgroundImage:
    """image: (320, 240, 3) uint8 BGR, mean of the frames. noise_bgr: standard deviation of one pixel over time."""

    image: NDArray[np.uint8]
    noise_bgr: tuple[float, float, float]
    frames: int


@dataclass(frozen=True, slots=True)
class BackgroundVersion:
    """One stored background image. created_at: when it was taken. level_bgr: its mean; None in older files.

    new_gel: the first one of a gel. copy_of: number of the older image that it is a copy of.
    """

    number: int
    created_at: datetime
    noise_bgr: tuple[float, float, float]
    level_bgr: tuple[float, float, float] | None
    frames: int
    new_gel: bool
    copy_of: int | None


class BackgroundStore(Protocol):
    """Where background images are kept, by serial number; see `slipguard.daemon.store.state_dir`."""

    def load_background(self, serial: str, number: int | None = None) -> BackgroundImage | None: ...

    def first_of_gel(self, serial: str) -> BackgroundImage | None: ...

    def save_background(self, serial: str, taken: BackgroundImage, *, new_gel: bool = False) -> None: ...

    def restore_background(self, serial: str, number: int) -> None: ...

    def background_versions(self, serial: str) -> list[BackgroundVersion]: ...


def average_background(images: Sequence[NDArray[np.uint8]], finger: str) -> BackgroundImage:
    """Return the background image and noise of an untouched gel.

    Args:
        images: `FRAMES` images, each (320, 240, 3) uint8 BGR.
        finger: Names the finger in errors.

    Raises:
        CommandRefused: The images are not still, or do not show a gel in color and in light.
    """
    stack = np.stack(images).astype(np.float32)
    mean = stack.mean(axis=0)
    # Consecutive frames differ by noise alone, even if the light drifts slowly.
    noise = np.diff(stack, axis=0).std(axis=(0, 1, 2)) / np.sqrt(2.0)
    if noise.max() > NOISE_MAX:
        raise CommandRefused(
            f"{finger}: the image is not still (noise {noise.max():.1f} gray levels, limit {NOISE_MAX:g}); "
            "keep the jaws open, empty and at rest, and try again"
        )
    change = _block_change(stack)
    if change > CHANGE_MAX:
        raise CommandRefused(
            f"{finger}: something touched the gel (the image changed by {change:.0f} gray levels, "
            f"limit {CHANGE_MAX:g}); keep the jaws open, empty and at rest, and try again"
        )
    image = np.clip(np.rint(mean), 0, 255).astype(np.uint8)
    unusable = check_background(images[0])
    if unusable is not None:
        raise CommandRefused(f"{finger}: {unusable}; nothing was stored")
    image.setflags(write=False)
    return BackgroundImage(image, (float(noise[0]), float(noise[1]), float(noise[2])), len(images))


def _block_change(stack: NDArray[np.float32]) -> float:
    """Return the largest change of a block's mean between beginning, middle and end of the frames, in gray levels."""
    thirds = np.stack([part.mean(axis=0) for part in np.array_split(stack, 3)])
    rows, columns = (size // BLOCK_PX for size in thirds.shape[1:3])
    whole = thirds[:, : rows * BLOCK_PX, : columns * BLOCK_PX]
    blocks = whole.reshape(3, rows, BLOCK_PX, columns, BLOCK_PX, -1).mean(axis=(2, 4))
    return float(np.ptp(blocks, axis=0).max())


async def collect_images(frames: asyncio.Queue[Frame], finger: str) -> list[NDArray[np.uint8]]:
    """Return the next `FRAMES` images of a sensor. Raises CommandRefused if they do not arrive in time."""
    images: list[NDArray[np.uint8]] = []
    try:
        async with asyncio.timeout(TIMEOUT_S):
            while len(images) < FRAMES:
                images.append((await frames.get()).image)
    except TimeoutError:
        raise CommandRefused(
            f"{finger}: received {len(images)} of {FRAMES} frames within {TIMEOUT_S:g} s; check the sensor"
        ) from None
    return images
