"""A data set recorded from sensors: frames as they arrive, each with a proposed label to be corrected by hand."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, AsyncIterator, Callable, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.datasets.dataset_files import BACKGROUNDS, IMAGES, MASKS, DataSetWriter, Files, png
from slipguard.devices import Frame, TactileSensor
from slipguard.errors import CommandRefused, DeviceError, DeviceLost, InputError
from slipguard.sim.contact_label import closed_region
from slipguard.sim.raster import f32

if TYPE_CHECKING:
    from slipguard.daemon.api.client import Client

Image = NDArray[np.uint8]

SMOOTHING_PX = 3.0
CHANGED_LEVELS = 9.0
"""Gray levels, largest of the three channels, smoothed. Noise of 3 levels becomes 0.3."""
CHANGED_SHARE = 0.3
"""Of the strongest change in the image; the glow around a press is weaker. Tuned on real presses."""
STRONGEST_QUANTILE = 0.99
DRIFT_ORDER = 2
DRIFT_ROUNDS = 4
DRIFT_FLOOR_LEVELS = 3.0
SMALLEST_PX = 250
"""0.7 mm2: smaller spots are dust and reflections."""
LABEL_NAME = f"proposed:|frame-no_contact|>{CHANGED_LEVELS:g}"


def propose_mask(image: Image, background: Image) -> NDArray[np.uint8]:
    """Return a proposed contact mask, (320, 240) uint8, 0 or 1: the region that differs from the background image.

    A slow drift of the light (a quadratic, fitted robustly) is removed first; gaps and holes are closed as in the
    training labels.

    Args:
        image, background: (320, 240, 3) uint8 BGR.
    """
    raw = f32(cv2.GaussianBlur(image.astype(np.float32) - background, (0, 0), SMOOTHING_PX))
    change = raw - _drift(raw)
    strength = np.abs(change).max(axis=2)
    changed = strength > max(CHANGED_LEVELS, CHANGED_SHARE * float(np.quantile(strength, STRONGEST_QUANTILE)))
    count, labels, figures, _ = cv2.connectedComponentsWithStats(changed.astype(np.uint8), connectivity=8)
    keep = [one for one in range(1, count) if figures[one, cv2.CC_STAT_AREA] >= SMALLEST_PX]
    return closed_region(np.isin(labels, keep))


def _drift(change: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the slow change of the light, (320, 240, 3) float32: a robust fit on a coarse grid."""
    height, width = change.shape[:2]
    coarse = cv2.resize(change, (width // 8, height // 8), interpolation=cv2.INTER_AREA)
    terms = _terms(*coarse.shape[:2])
    levels = coarse.reshape(-1, 3)
    weights = np.ones(len(levels), np.float32)
    fit = np.zeros((terms.shape[1], 3), np.float32)
    for _ in range(DRIFT_ROUNDS):
        fit = np.linalg.lstsq(terms * weights[:, None], levels * weights[:, None], rcond=None)[0]
        distance = np.abs(levels - terms @ fit).max(axis=1)
        weights = 1.0 / (1.0 + (distance / max(float(np.median(distance)), DRIFT_FLOOR_LEVELS)) ** 2)
    return np.asarray((_terms(height, width) @ fit).reshape(height, width, 3), np.float32)


def _terms(height: int, width: int) -> NDArray[np.float32]:
    """Return the monomials up to DRIFT_ORDER on an image spanning -1..1, (height * width, 6)."""
    y, x = np.mgrid[0:height, 0:width].astype(np.float32)
    x, y = ((x + 0.5) / width * 2 - 1).ravel(), ((y + 0.5) / height * 2 - 1).ravel()
    powers = [(i, j) for i in range(DRIFT_ORDER + 1) for j in range(DRIFT_ORDER + 1 - i)]
    return np.stack([x**i * y**j for i, j in powers], axis=-1).astype(np.float32)


NO_FRAME_TIMEOUT_S = 10.0
"""Recording ends after this time without a good frame."""


@dataclass(frozen=True, slots=True, eq=False)
class SensorImage:
    """One image of one sensor. image: (320, 240, 3) uint8 BGR."""

    serial: str
    image: Image
    sequence: int


async def record_dataset(
    out_dir: Path,
    images: AsyncIterator[SensorImage],
    count: int,
    backgrounds: Mapping[str, Image],
    progress: Callable[[int], None] = lambda done: None,
) -> int:
    """Write `count` images into a new or empty folder and return how many of them show contact.

    The folders are those of a rendered data set; the masks are proposals, to be corrected by hand. If it ends early, a
    complete smaller data set remains.

    Args:
        backgrounds: background image of every sensor, by serial number.
    """
    touched = 0
    under = {serial: png(image) for serial, image in backgrounds.items()}
    with DataSetWriter(out_dir) as writer:
        async for one in images:
            mask = await asyncio.to_thread(propose_mask, one.image, backgrounds[one.serial])
            share = float(mask.mean())
            files: Files = {
                IMAGES: png(one.image),
                MASKS: png(mask * np.uint8(255)),
                BACKGROUNDS: under[one.serial],
            }
            line = {
                "file": f"{writer.written:06d}.png",
                "split": "recorded",
                "serial": one.serial,
                "sequence": one.sequence,
                "recorded_at": datetime.now(UTC).isoformat(timespec="milliseconds"),
                "has_contact": share > 0.0,
                "contact_share": round(share, 5),
                "label": LABEL_NAME,
            }
            writer.add(line, files)
            touched += share > 0.0
            progress(writer.written)
            if writer.written >= count:
                break
    return touched


async def from_daemon(source: Client, fingers: list[str], every_s: float) -> AsyncGenerator[SensorImage, None]:
    """Yield the frames of a running daemon, finger by finger, each once.

    Raises CommandRefused if a finger has no frame for a while.
    """
    loop = asyncio.get_running_loop()
    last = dict.fromkeys(fingers, -1)
    good_at_s = due_s = loop.time()
    while True:
        for finger in fingers:
            try:
                response = await asyncio.to_thread(source.frame, finger)
            except CommandRefused:
                if loop.time() - good_at_s > NO_FRAME_TIMEOUT_S:
                    raise
                continue
            if response.sequence == last[finger]:
                continue
            last[finger], good_at_s = response.sequence, loop.time()
            image = cv2.imdecode(np.frombuffer(response.png, np.uint8), cv2.IMREAD_COLOR)
            if image is None:
                raise InputError("the daemon sent no image; is it another version of slipguard?")
            yield SensorImage(response.serial, np.asarray(image, np.uint8), response.sequence)
        due_s = max(due_s + every_s, loop.time())
        await asyncio.sleep(due_s - loop.time())


@asynccontextmanager
async def opened(sensors: list[TactileSensor]) -> AsyncIterator[list[TactileSensor]]:
    """Open the sensors, which may know their serial numbers only then, and close them at the end.

    Raises DeviceLost if one is missing.
    """
    try:
        for sensor in sensors:
            await sensor.open()
        yield sensors
    finally:
        for sensor in sensors:
            await sensor.close()


async def from_sensors(sensors: list[TactileSensor], every_s: float) -> AsyncGenerator[SensorImage, None]:
    """Yield the frames of opened sensors. Raises any persistent DeviceError."""
    loop = asyncio.get_running_loop()
    due_s = loop.time()
    while True:
        for sensor in sensors:
            frame = await good_frame(sensor)
            yield SensorImage(sensor.serial, frame.image, frame.sequence)
        due_s = max(due_s + every_s, loop.time())
        await asyncio.sleep(due_s - loop.time())


async def good_frame(sensor: TactileSensor) -> Frame:
    """Return the next undamaged frame; raise a persistent DeviceError."""
    loop = asyncio.get_running_loop()
    begin_s = loop.time()
    while True:
        try:
            return await sensor.next_frame()
        except DeviceError as error:
            if isinstance(error, DeviceLost) or loop.time() - begin_s > NO_FRAME_TIMEOUT_S:
                raise
