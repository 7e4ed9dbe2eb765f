"""One finger's path: camera, newest frame, worker, newest estimate. It owns the sensor and its pipeline."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from slipguard.daemon.backoff import Backoff
from slipguard.daemon.health import Health
from slipguard.daemon.latest import Latest
from slipguard.daemon.worker import Worker
from slipguard.devices import Frame, TactileSensor
from slipguard.errors import DeviceError, FrameCorrupt, FrameFrozen
from slipguard.perception.estimate import Estimate


class Perceiver(Protocol):
    """What a finger needs of `slipguard.perception.pipeline.Pipeline`."""

    def process(self, frame: Frame) -> Estimate: ...

    def reset_reference(self) -> None: ...


@dataclass(frozen=True, slots=True)
class Seen:
    """An estimate with the loop times at which its frame came in and the answer was ready."""

    estimate: Estimate
    handed_at_s: float
    ready_at_s: float


@dataclass(slots=True)
class FingerCounts:
    """What happened to the frames of one finger since the start."""

    frames: int = 0
    corrupt: int = 0
    frozen: int = 0
    late: int = 0
    """Replaced by a newer one before the worker was free."""
    skipped: dict[str, int] = field(default_factory=dict)


class Finger:
    """Runs one sensor for as long as the daemon lives; a missing one is waited for.

    `make_pipeline(serial)` is called each time the sensor opens, so that the unit's own no-contact image is used.
    `on_news` is called after each new estimate and each change of health.
    """

    def __init__(
        self,
        name: str,
        sensor: TactileSensor,
        worker: Worker,
        make_pipeline: Callable[[str], Perceiver],
        retry_s: float,
        on_news: Callable[[], None],
    ) -> None:
        self.name = name
        self.sensor = sensor
        self.health = Health(name)
        self.counts = FingerCounts()
        self.serial: str | None = None
        self.newest: Seen | None = None
        """None where the newest answer belongs to an older reference or no-contact image."""
        self.captured_at_s: float | None = None
        """Of the newest frame that was judged."""
        self.newest_image: NDArray[np.uint8] | None = None
        self.tap: asyncio.Queue[Frame] | None = None
        """Set by a calibration: a copy of every good frame goes here."""
        self._worker = worker
        self._make_pipeline = make_pipeline
        self.pipeline: Perceiver | None = None
        self._backoff = Backoff(retry_s)
        self._on_news = on_news
        self._waiting: Latest[tuple[Frame, float]] = Latest()
        self._wants_reset = False

    def reset_reference(self) -> None:
        """Take a new reference from the next stable contact on."""
        self._wants_reset = True
        self.newest = None

    def renew_pipeline(self) -> None:
        """Build the pipeline again: the unit's no-contact image has changed."""
        if self.serial is not None:
            self.pipeline = self._make_pipeline(self.serial)
            self.newest = None

    async def run(self) -> None:
        """Capture and perceive until cancelled."""
        perceiving = asyncio.create_task(self._perceive(), name=f"{self.name}: perceive")
        try:
            while True:
                try:
                    await self._stream()
                except DeviceError as error:
                    self.health.lost(str(error))
                    self._on_news()
                    await self.sensor.close()
                    await self._backoff.wait()
                if perceiving.done():
                    perceiving.result()
        finally:
            perceiving.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await perceiving
            await self.sensor.close()

    async def _stream(self) -> None:
        await self.sensor.open()
        self.serial = self.sensor.serial
        self.pipeline = self._make_pipeline(self.serial)
        loop = asyncio.get_running_loop()
        while True:
            try:
                frame = await self.sensor.next_frame()
            except FrameCorrupt as error:
                self.counts.corrupt += 1
                self._trouble(str(error))
                continue
            except FrameFrozen as error:
                self.counts.frozen += 1
                self._trouble(str(error))
                continue
            self._backoff.reset()
            self.counts.frames += 1
            self.newest_image = frame.image
            if self.tap is not None and not self.tap.full():
                self.tap.put_nowait(frame)
            self._waiting.put((frame, loop.time()))
            self.counts.late = self._waiting.overwritten

    def _trouble(self, why: str) -> None:
        self.health.troubled(why)
        self._on_news()

    async def _perceive(self) -> None:
        loop = asyncio.get_running_loop()
        while True:
            frame, handed_at_s = await self._waiting.next()
            pipeline = self.pipeline
            if pipeline is None:
                continue
            if self._wants_reset:
                self._wants_reset = False
                pipeline.reset_reference()
            try:
                estimate = await self._worker.run(pipeline.process, frame)
            except FrameCorrupt as error:
                self.counts.corrupt += 1
                self._trouble(str(error))
                continue
            self.captured_at_s = frame.captured_at_s
            self.health.good(loop.time())
            if pipeline is not self.pipeline or self._wants_reset:
                continue
            if estimate.skipped:
                self.counts.skipped[estimate.skipped] = self.counts.skipped.get(estimate.skipped, 0) + 1
            self.newest = Seen(estimate, handed_at_s, loop.time())
            self._on_news()
