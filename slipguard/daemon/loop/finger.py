"""One finger's path: camera, newest frame, worker, newest estimate. It owns the sensor and its pipeline."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

from slipguard.cancellation import raise_if_cancelled
from slipguard.daemon.loop.backoff import Backoff
from slipguard.daemon.loop.gel_condition import GelCondition
from slipguard.daemon.loop.health import Health
from slipguard.daemon.loop.latest import Latest
from slipguard.daemon.loop.worker import Worker
from slipguard.devices import Frame, TactileSensor
from slipguard.errors import DeviceError, DeviceTimeout, FrameCorrupt, FrameFrozen, SlipguardError
from slipguard.perception.contact.patch import Patch
from slipguard.perception.contact.second_finger import repeat_estimate, second_finger_can_skip
from slipguard.perception.estimate import Estimate

REOPEN_S = 2.0
"""A sensor that is there but has given nothing good for so long is closed and opened again."""


class PerceptionPipeline(Protocol):
    """What a finger needs of `slipguard.perception.pipeline.Pipeline`."""

    def process(self, frame: Frame) -> Estimate: ...

    def keep_estimate(self, captured_at_s: float) -> None: ...

    def reset_reference(self) -> None: ...

    @property
    def last_patch(self) -> Patch | None: ...


@dataclass(frozen=True, slots=True)
class TimedEstimate:
    """An estimate with the loop times at which its frame came in and the answer was ready."""

    estimate: Estimate
    handed_at_s: float
    ready_at_s: float


@dataclass(frozen=True, slots=True, eq=False)
class ProcessedFrame:
    """One frame that went through the pipeline, for observers.

    new_reference, new_pipeline: the pipeline forgot its reference, or was built anew, just before. estimate: None where
    the frame was refused, then `refused` says why. patch: the contact found in it.
    """

    frame: Frame
    judged_at_s: float
    new_reference: bool
    new_pipeline: bool
    estimate: Estimate | None = None
    refused: str | None = None
    patch: Patch | None = None


@dataclass(slots=True)
class FingerCounts:
    """What happened to the frames of one finger since the start."""

    frames: int = 0
    corrupt: int = 0
    frozen: int = 0
    stalled: int = 0
    missed: int = 0
    """Counted by the camera, but never here."""
    late: int = 0
    """Replaced by a newer one before the worker was free."""
    skipped: dict[str, int] = field(default_factory=dict)

    def note(self, error: DeviceError) -> None:
        """Count one frame that did not come, or came damaged."""
        self.corrupt += isinstance(error, FrameCorrupt)
        self.frozen += isinstance(error, FrameFrozen)
        self.stalled += isinstance(error, DeviceTimeout)


class Finger:
    """Runs one sensor for as long as the daemon lives; a missing one is waited for.

    `make_pipeline(serial)` is called for each new serial, so that the unit's own no-contact image is used; a sensor
    that comes back goes on with its reference. `on_news` is called after each new estimate and each change of health.
    """

    def __init__(
        self,
        name: str,
        sensor: TactileSensor,
        worker: Worker,
        make_pipeline: Callable[[str], PerceptionPipeline],
        retry_s: float,
        on_news: Callable[[], None],
    ) -> None:
        self.name = name
        self.sensor = sensor
        self.health = Health(name)
        self.counts = FingerCounts()
        self.serial: str | None = None
        self.pipeline: PerceptionPipeline | None = None
        self.newest: TimedEstimate | None = None
        """None where the newest answer belongs to an older reference or no-contact image."""
        self.answered = asyncio.Event()
        """Set while there is a `newest`."""
        self.captured_at_s: float | None = None
        """Of the newest frame that was judged."""
        self.newest_frame: Frame | None = None
        """The last good one; None while the sensor is gone."""
        self.observers: list[Callable[[ProcessedFrame], None]] = []
        self.gel: GelCondition | None = None
        """How it is when untouched, after the first minute of that; see `slipguard.daemon.loop.gel_monitor`."""
        self.tap: asyncio.Queue[Frame] | None = None
        """Set by a calibration: a copy of every good frame goes here."""
        self.other: Finger | None = None
        """Whose better sight may spare this finger's frames; None: every frame is looked at."""
        self.refresh_s = 0.0
        """A spared finger is looked at again after this time."""
        self._worker = worker
        self._make_pipeline = make_pipeline
        self._backoff = Backoff(retry_s, longest_s=2 * retry_s)  # a cable pushed in again is noticed within a second
        self._on_news = on_news
        self._waiting: Latest[tuple[Frame, float]] = Latest()
        self._wants_reset = False
        self._streaming = False

    def reset_reference(self) -> None:
        """Take a new reference from the next stable contact on."""
        self._wants_reset = True
        self._forget()

    def renew_pipeline(self) -> None:
        """Build the pipeline again: the unit's no-contact image has changed."""
        if self.serial is not None:
            self.pipeline = self._make_pipeline(self.serial)
            self._forget()

    def _forget(self) -> None:
        self.newest = None
        self.answered.clear()

    async def run(self) -> None:
        """Capture and perceive until cancelled."""
        try:
            async with asyncio.TaskGroup() as group:
                group.create_task(self._capture(), name=f"{self.name}: capture")
                group.create_task(self._perceive(), name=f"{self.name}: perceive")
        finally:
            await self.sensor.close()

    async def _capture(self) -> None:
        """Frames for ever; what cannot be opened, or has gone, is tried again after a pause."""
        while True:
            try:
                await self._stream()
            except SlipguardError as error:
                self._streaming = False
                self.newest_frame = None
                self.health.set_disconnected(str(error))
                self._on_news()
                await self.sensor.close()
                raise_if_cancelled()
                await self._backoff.wait()

    async def _stream(self) -> None:
        """Hand frames on until the sensor is gone, or has given nothing good for `REOPEN_S`."""
        await self.sensor.open()
        if self.sensor.serial != self.serial:
            self.serial, self.pipeline = self.sensor.serial, None
        if self.pipeline is None:
            self.renew_pipeline()
        self._streaming = True
        loop = asyncio.get_running_loop()
        good_at_s = loop.time()
        sequence: int | None = None
        while True:
            raise_if_cancelled()
            try:
                frame = await self.sensor.next_frame()
            except (FrameCorrupt, FrameFrozen, DeviceTimeout) as error:
                self.counts.note(error)
                self._trouble(str(error))
                if loop.time() - good_at_s > REOPEN_S:
                    raise
                continue
            good_at_s = loop.time()
            self._backoff.reset()
            self.counts.frames += 1
            self.counts.missed += max(0, frame.sequence - sequence - 1) if sequence is not None else 0
            sequence = frame.sequence
            self.newest_frame = frame
            if self.tap is not None and not self.tap.full():
                self.tap.put_nowait(frame)
            self._waiting.put((frame, good_at_s))
            self.counts.late = self._waiting.overwritten

    def _trouble(self, why: str) -> None:
        self.health.set_error(why)
        self._on_news()

    async def _perceive(self) -> None:
        loop = asyncio.get_running_loop()
        used: PerceptionPipeline | None = None
        while True:
            frame, handed_at_s = await self._waiting.next()
            pipeline = self.pipeline
            if pipeline is None:
                continue
            new_pipeline, used = pipeline is not used, pipeline
            new_reference, self._wants_reset = self._wants_reset, False
            if new_reference:
                pipeline.reset_reference()
            try:
                estimate = self._spared(frame, pipeline)
                if estimate is None:
                    estimate = await self._worker.run(pipeline.process, frame)
            except SlipguardError as error:
                self.counts.corrupt += 1
                self._trouble(str(error))
                self._observe(ProcessedFrame(frame, loop.time(), new_reference, new_pipeline, refused=str(error)))
                continue
            patch = pipeline.last_patch if self.observers else None
            self._observe(ProcessedFrame(frame, loop.time(), new_reference, new_pipeline, estimate, patch=patch))
            if not self._streaming:
                continue
            self.captured_at_s = frame.captured_at_s
            self.health.set_ready(loop.time())
            if pipeline is not self.pipeline or self._wants_reset:
                continue
            if estimate.skipped:
                self.counts.skipped[estimate.skipped] = self.counts.skipped.get(estimate.skipped, 0) + 1
            self.newest = TimedEstimate(estimate, handed_at_s, loop.time())
            self.answered.set()
            self._on_news()

    def _spared(self, frame: Frame, pipeline: PerceptionPipeline) -> Estimate | None:
        """The last answer, where the other finger makes this look needless."""
        own = None if self.newest is None else self.newest.estimate
        seen = None if self.other is None or self.other.newest is None else self.other.newest.estimate
        if own is None or not second_finger_can_skip(own, seen, frame.captured_at_s, self.refresh_s):
            return None
        pipeline.keep_estimate(frame.captured_at_s)
        return repeat_estimate(own, frame.captured_at_s, frame.sequence)

    def _observe(self, processed: ProcessedFrame) -> None:
        for observer in self.observers:
            observer(processed)
