"""A data set from a sensor: frames as they come, with a proposed label each."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.datasets.files import BACKGROUNDS, IMAGES, MASKS, DataSetWriter, Files, png
from slipguard.datasets.label_proposal import LABEL_NAME, propose
from slipguard.devices import Frame, TactileSensor
from slipguard.errors import CommandRefused, DeviceError, DeviceLost, InputError

Image = NDArray[np.uint8]
PATIENCE_S = 10.0
"""Without a good frame for so long recording ends: whatever is wrong does not mend itself."""


@dataclass(frozen=True, slots=True, eq=False)
class SensorImage:
    """One picture of one sensor. image: (320, 240, 3) uint8 BGR."""

    serial: str
    image: Image
    sequence: int


class FrameSource(Protocol):
    """A running daemon, asked: `slipguard.daemon.api.client.Client.frame`."""

    def frame(self, finger: str) -> DaemonFrame: ...


class DaemonFrame(Protocol):
    """What a daemon answers."""

    @property
    def png(self) -> bytes: ...

    @property
    def serial(self) -> str: ...

    @property
    def sequence(self) -> int: ...


async def record_dataset(
    out_dir: Path,
    shots: AsyncIterator[SensorImage],
    count: int,
    backgrounds: Mapping[str, Image],
    progress: Callable[[int], None] = lambda done: None,
) -> int:
    """Write `count` shots into a new or empty folder and return how many of them show contact.

    images/, backgrounds/ and masks/ as in a rendered data set; the masks are proposals, to be corrected by hand.
    backgrounds: no-contact image by serial, of every sensor. Ended early it leaves a whole data set of fewer frames.
    """
    touched = 0
    under = {serial: png(image) for serial, image in backgrounds.items()}
    with DataSetWriter(out_dir) as writer:
        async for shot in shots:
            mask = await asyncio.to_thread(propose, shot.image, backgrounds[shot.serial])
            share = float(mask.mean())
            files: Files = {
                IMAGES: png(shot.image),
                MASKS: png(mask * np.uint8(255)),
                BACKGROUNDS: under[shot.serial],
            }
            line = {
                "file": f"{writer.written:06d}.png",
                "split": "recorded",
                "serial": shot.serial,
                "sequence": shot.sequence,
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


async def from_daemon(source: FrameSource, fingers: list[str], every_s: float) -> AsyncIterator[SensorImage]:
    """What a running daemon sees, finger after finger; a frame it has had before is waited out.

    Raises CommandRefused when a finger has had no frame for a while.
    """
    loop = asyncio.get_running_loop()
    last = dict.fromkeys(fingers, -1)
    good_at_s = due_s = loop.time()
    while True:
        for finger in fingers:
            try:
                seen = await asyncio.to_thread(source.frame, finger)
            except CommandRefused:
                if loop.time() - good_at_s > PATIENCE_S:
                    raise
                continue
            if seen.sequence == last[finger]:
                continue
            last[finger], good_at_s = seen.sequence, loop.time()
            image = cv2.imdecode(np.frombuffer(seen.png, np.uint8), cv2.IMREAD_COLOR)
            if image is None:
                raise InputError("the daemon sent no picture; is it another version of slipguard?")
            yield SensorImage(seen.serial, np.asarray(image, np.uint8), seen.sequence)
        due_s = max(due_s + every_s, loop.time())
        await asyncio.sleep(due_s - loop.time())


async def from_sensors(sensors: list[TactileSensor], every_s: float) -> AsyncIterator[SensorImage]:
    """Open the sensors and take what they see; the devices are let go when the iterator is closed.

    Raises DeviceLost where one is not there, and any DeviceError that lasts.
    """
    loop = asyncio.get_running_loop()
    try:
        for sensor in sensors:
            await sensor.open()
        due_s = loop.time()
        while True:
            for sensor in sensors:
                frame = await good_frame(sensor)
                yield SensorImage(sensor.serial, frame.image, frame.sequence)
            due_s = max(due_s + every_s, loop.time())
            await asyncio.sleep(due_s - loop.time())
    finally:
        for sensor in sensors:
            await sensor.close()


async def good_frame(sensor: TactileSensor) -> Frame:
    """The newest frame, after those that came damaged; raises the DeviceError that lasts."""
    loop = asyncio.get_running_loop()
    begin_s = loop.time()
    while True:
        try:
            return await sensor.next_frame()
        except DeviceError as error:
            if isinstance(error, DeviceLost) or loop.time() - begin_s > PATIENCE_S:
                raise
