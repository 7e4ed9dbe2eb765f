"""One finger: its capture, its perception pipeline in a worker thread, and its newest estimate."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from slipguard.cancellation import raise_if_cancelled
from slipguard.control.messages import Condition, FingerHealth
from slipguard.daemon.loop.async_tools import Backoff
from slipguard.daemon.loop.capture import SensorCapture, StreamRestarts
from slipguard.daemon.loop.device_health import Health
from slipguard.daemon.loop.driver_failure import DRIVER_ERRORS, failure_reason
from slipguard.daemon.loop.frame_causes import STALE_S, FrameFigures, find_cause
from slipguard.daemon.loop.observers import Observers
from slipguard.daemon.loop.worker import Worker
from slipguard.devices import Frame, TactileSensor
from slipguard.errors import FrameTorn, SlipguardError
from slipguard.perception.estimate import Estimate
from slipguard.perception.patch import Patch
from slipguard.perception.skipping import repeat_estimate, second_finger_can_skip

STUCK_AFTER_S = 0.05
STUCK_WAITED_SHARE = 0.25
"""A frame that is late hangs, unless its thread waited for a processor for this share of the time since it was late."""


class PerceptionPipeline(Protocol):
    """The part of `slipguard.perception.pipeline.Pipeline` that a finger uses."""

    def process(self, frame: Frame) -> Estimate: ...

    def keep_estimate(self, captured_at_s: float) -> None: ...

    def reset_reference(self) -> None: ...

    @property
    def last_patch(self) -> Patch | None: ...


@dataclass(frozen=True, slots=True)
class TimedEstimate:
    """An estimate with the loop times at which its frame was received and the estimate was ready."""

    estimate: Estimate
    received_at_s: float
    ready_at_s: float


@dataclass(frozen=True, slots=True, eq=False)
class ProcessedFrame:
    """One frame that went through the pipeline, for observers.

    new_reference, new_pipeline: the pipeline's reference was reset, or the pipeline was built again, just before this
    frame. estimate: None if the pipeline refused the frame for the reason in `refused`. patch: the contact in it.
    """

    frame: Frame
    processed_at_s: float
    new_reference: bool
    new_pipeline: bool
    estimate: Estimate | None = None
    refused: str | None = None
    patch: Patch | None = None


class Finger:
    """Runs capture and perception of one finger until cancelled.

    A sensor that comes back continues with its reference; another unit gets a pipeline of its own.

    Args:
        make_pipeline: Called for each new serial number, so that the unit's own background image is used.
        on_change: Called after each new estimate and each change of health.
    """

    def __init__(
        self,
        name: str,
        sensor: TactileSensor,
        worker: Worker,
        make_pipeline: Callable[[str], PerceptionPipeline],
        retry_s: float,
        restarts: StreamRestarts,
        on_change: Callable[[], None],
    ) -> None:
        self.name = name
        self.capture = SensorCapture(name, sensor, retry_s, restarts, self._use_pipeline_of, on_change)
        self.pipeline: PerceptionPipeline | None = None
        self.newest: TimedEstimate | None = None
        """None while the last estimate belongs to an older reference or background image."""
        self.has_estimate = asyncio.Event()
        """Set while there is a `newest`."""
        self.captured_at_s: float | None = None
        """Capture time of the newest processed frame."""
        self.observers: Observers[ProcessedFrame] = Observers()
        self._worker = worker
        self._make_pipeline = make_pipeline
        self._pipeline_serial: str | None = None
        self._on_change = on_change
        self._retry_s = retry_s
        self._processing_since_s: float | None = None
        """Since when the worker has been processing a frame; None if it is not."""
        self._late_since: tuple[float, float] | None = None
        """When that frame was first found late, and for how long the worker had waited for a processor by then."""
        self._peer: Finger | None = None
        self._refresh_s = 0.0
        self._wants_reset = False

    @property
    def serial(self) -> str | None:
        """Serial number of the sensor opened last; None before that."""
        return self.capture.serial

    @property
    def health(self) -> Health:
        """Health of the sensor and its frames."""
        return self.capture.health

    def observe(self, now_s: float) -> tuple[FingerHealth, Estimate | None]:
        """Return the finger's health for the controller, and its estimate if that is fresh."""
        age_s = now_s - self.captured_at_s if self.captured_at_s is not None else math.inf
        figures = FrameFigures(
            connected=self.health.state != "disconnected",
            age_s=age_s,
            refused=self.health.reason,
            hangs_s=self._hangs_s(now_s) if age_s > STALE_S else None,
        )
        condition, why = find_cause(figures.with_arrivals(self.capture.arrivals, now_s))
        fresh = self.newest.estimate if self.newest is not None and condition is Condition.FRESH else None
        if fresh is not None and fresh.unusable:
            condition = Condition.BLIND
        return FingerHealth(condition, age_s, why), fresh

    def delivers(self, now_s: float) -> bool:
        """Return whether recent frames were processed, even if they do not show the gel."""
        return self.observe(now_s)[0].condition in (Condition.FRESH, Condition.BLIND)

    def _hangs_s(self, now_s: float) -> float | None:
        """Return for how long a late frame's processing has not returned; None if its thread waits for a processor."""
        waited_s = self._worker.waited_s()
        if waited_s is None or self._processing_since_s is None:
            return None
        self._late_since = since_s, before_s = self._late_since or (now_s, waited_s)
        if now_s - since_s < STUCK_AFTER_S or waited_s - before_s > STUCK_WAITED_SHARE * (now_s - since_s):
            return None
        return now_s - self._processing_since_s

    def skip_frames_after(self, peer: Finger, refresh_s: float) -> None:
        """Keep the last estimate while `peer` sees the object unchanged, for at most `refresh_s`."""
        self._peer, self._refresh_s = peer, refresh_s

    def reset_reference(self) -> None:
        """Take a new reference from the next stable contact on."""
        self._wants_reset = True
        self._drop_estimate()

    def renew_pipeline(self) -> None:
        """Build the pipeline again, because the unit's background image has changed."""
        if self.serial is not None:
            self.pipeline, self._pipeline_serial = self._make_pipeline(self.serial), self.serial
            self._drop_estimate()

    def _use_pipeline_of(self, serial: str) -> None:
        if serial != self._pipeline_serial:
            self.pipeline = None
        if self.pipeline is None:
            self.renew_pipeline()

    def _drop_estimate(self) -> None:
        self.newest = None
        self.has_estimate.clear()

    async def run(self) -> None:
        """Capture and perceive until cancelled."""
        try:
            async with asyncio.TaskGroup() as group:
                group.create_task(self.capture.run(), name=f"{self.name}: capture")
                group.create_task(self._perceive(), name=f"{self.name}: perceive")
        finally:
            await self.capture.close()

    async def _perceive(self) -> None:
        """Process the newest frame, again and again; a frame that fails is refused and costs nothing else."""
        loop, capture = asyncio.get_running_loop(), self.capture
        used: PerceptionPipeline | None = None
        backoff, failed = Backoff(self._retry_s), False
        while True:
            frame, received_at_s = await capture.frames.next()
            pipeline = self.pipeline
            if pipeline is None:
                continue
            new_pipeline, used = pipeline is not used, pipeline
            new_reference, self._wants_reset = self._wants_reset, False
            try:
                if new_reference:
                    pipeline.reset_reference()
                estimate = self._kept_estimate(frame, pipeline) or await self._process(pipeline, frame)
            except DRIVER_ERRORS as error:
                raise_if_cancelled()
                reason = failure_reason(pipeline, error, self.health)
                capture.refuse_frame(reason, torn=isinstance(error, FrameTorn))
                self.observers.notify(ProcessedFrame(frame, loop.time(), new_reference, new_pipeline, refused=reason))
                if not isinstance(error, SlipguardError):
                    self._drop_estimate()
                    if failed:  # the first in a row costs one frame; a pause would be longer than `frames_timeout_s`
                        await backoff.wait()
                    failed = True
                continue
            failed = False
            backoff.reset()
            patch = pipeline.last_patch if self.observers else None
            self.observers.notify(
                ProcessedFrame(frame, loop.time(), new_reference, new_pipeline, estimate, patch=patch)
            )
            if capture.streaming:
                self._use_estimate(estimate, pipeline, received_at_s, loop.time())

    async def _process(self, pipeline: PerceptionPipeline, frame: Frame) -> Estimate:
        self._processing_since_s = asyncio.get_running_loop().time()
        try:
            return await self._worker.run(pipeline.process, frame)
        finally:
            self._processing_since_s = self._late_since = None

    def _use_estimate(
        self, estimate: Estimate, pipeline: PerceptionPipeline, received_at_s: float, now_s: float
    ) -> None:
        """Make this the newest estimate, unless pipeline or reference were replaced while it was computed."""
        self.captured_at_s = estimate.captured_at_s
        if estimate.unusable:
            self.health.set_error(estimate.declined or "")
            self._on_change()
        else:
            self.health.set_ready(now_s)
        if pipeline is not self.pipeline or self._wants_reset:
            return
        if estimate.skipped:
            self.capture.counts.add_skipped(estimate.skipped)
        self.newest = TimedEstimate(estimate, received_at_s, now_s)
        self.has_estimate.set()
        self._on_change()

    def _kept_estimate(self, frame: Frame, pipeline: PerceptionPipeline) -> Estimate | None:
        """Return the last estimate for this frame if the other finger makes processing it unnecessary."""
        own = None if self.newest is None else self.newest.estimate
        other = None if self._peer is None or self._peer.newest is None else self._peer.newest.estimate
        if own is None or not second_finger_can_skip(own, other, frame.captured_at_s, self._refresh_s):
            return None
        pipeline.keep_estimate(frame.captured_at_s)
        return repeat_estimate(own, frame.captured_at_s, frame.sequence)
