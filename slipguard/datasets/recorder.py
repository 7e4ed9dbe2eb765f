"""A data set recorded from sensors: frames as they arrive, each with a proposed label to be corrected by hand."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, AsyncIterator, Awaitable, Callable, Mapping, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from slipguard.datasets.dataset_files import BACKGROUNDS, IMAGES, DataSetWriter, Image, png
from slipguard.devices import TactileSensor
from slipguard.errors import CommandRefused, DeviceError, DeviceLost, InputError
from slipguard.perception.patch import find_patch
from slipguard.perception.segmenter import Segmenter

if TYPE_CHECKING:
    from slipguard.daemon.api.client import Client

NO_FRAME_TIMEOUT_S = 10.0
"""Recording ends after this time without a good frame."""
SMALLEST_PX = 250
"""0.7 mm2: smaller spots are dust and reflections."""
LABEL_NAME = "proposed by the network"


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
    segmenter = Segmenter()
    under = {serial: png(image) for serial, image in backgrounds.items()}
    with DataSetWriter(out_dir) as writer:
        async for one in images:
            mask = await asyncio.to_thread(propose_mask, segmenter, one.image, backgrounds[one.serial])
            source = {
                "split": "recorded",
                "serial": one.serial,
                "sequence": one.sequence,
                "recorded_at": datetime.now(UTC).isoformat(timespec="milliseconds"),
                "label": LABEL_NAME,
            }
            writer.add(source, mask, {IMAGES: png(one.image), BACKGROUNDS: under[one.serial]})
            touched += bool(mask.any())
            progress(writer.written)
            if writer.written >= count:
                break
    return touched


def propose_mask(segmenter: Segmenter, image: Image, background: Image) -> Image:
    """Return a proposed contact mask, (320, 240) uint8, 0 or 1: what the network takes for contact.

    Args:
        image, background: (320, 240, 3) uint8 BGR.
    """
    probability = segmenter.segment(image, background)
    frame_px = image.shape[0] / probability.shape[0]
    patch = find_patch(probability, segmenter.threshold, SMALLEST_PX, frame_px)
    if patch is None:
        return np.zeros(image.shape[:2], np.uint8)
    return (cv2.resize(patch.full_probability(), image.shape[1::-1]) > segmenter.threshold).astype(np.uint8)


Reader = Callable[[], Awaitable[SensorImage | None]]
"""Returns the next image of one finger; None: there is no new one."""


async def images_of(readers: Sequence[Reader], every_s: float) -> AsyncGenerator[SensorImage, None]:
    """Yield the images of all fingers, one of each every `every_s`.

    Raises DeviceLost, and any other error of a finger after `NO_FRAME_TIMEOUT_S` without a good image.
    """
    loop = asyncio.get_running_loop()
    good_at_s = due_s = loop.time()
    while True:
        for read in readers:
            try:
                image = await read()
            except (CommandRefused, DeviceError) as error:
                if isinstance(error, DeviceLost) or loop.time() - good_at_s > NO_FRAME_TIMEOUT_S:
                    raise
                continue
            if image is not None:
                good_at_s = loop.time()
                yield image
        due_s = max(due_s + every_s, loop.time())
        await asyncio.sleep(due_s - loop.time())


def daemon_reader(client: Client, finger: str) -> Reader:
    """Return the reader of a running daemon's finger."""
    last = -1

    async def read() -> SensorImage | None:
        nonlocal last
        response = await asyncio.to_thread(client.frame, finger)
        if response.sequence == last:
            return None
        last = response.sequence
        image = cv2.imdecode(np.frombuffer(response.png, np.uint8), cv2.IMREAD_COLOR)
        if image is None:
            raise InputError("the daemon sent no image; is it another version of slipguard?")
        return SensorImage(response.serial, np.asarray(image, np.uint8), response.sequence)

    return read


def sensor_reader(sensor: TactileSensor) -> Reader:
    """Return the reader of an opened sensor."""

    async def read() -> SensorImage:
        frame = await sensor.next_frame()
        return SensorImage(sensor.serial, frame.image, frame.sequence)

    return read


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
