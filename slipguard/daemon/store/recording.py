"""Record the running service: what is recorded, and when it is kept."""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import json
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Protocol

import cv2

from slipguard import __version__
from slipguard.config import Config
from slipguard.control.state import Phase
from slipguard.daemon.loop.decision import Decision
from slipguard.daemon.loop.event_log import Event
from slipguard.daemon.loop.finger import ProcessedFrame
from slipguard.daemon.loop.service import Service
from slipguard.errors import InputError
from slipguard.perception.estimate import Estimate
from slipguard.perception.segmenter import default_model_path
from slipguard.recording import messages as m
from slipguard.recording.recorder import RecordedCycle, RecordedFrame, RecordedMessage, Recorder, RecorderSettings
from slipguard.recording.ring import Ring, RingLimits
from slipguard.recording.writer import RecordingClock, RecordingHeader

SEGMENT_S = 20.0
IDLE_IMAGE_S = 1.0
"""While nothing is held or touched, one image in this time is recorded."""
STOP_S = 5.0


def make_recorder(service: Service, folder: Path) -> Recorder:
    """Return a recorder of a service into `folder`; not yet started."""
    config = service.config.recording
    loop = asyncio.get_running_loop()
    # 0 except on a virtual clock, on which each file continues where the one before ended.
    virtual_s = loop.time() - time.monotonic()
    limits = RingLimits(
        max(round(config.ring_s / SEGMENT_S), 1), config.ring_max_mb * 2**20, config.kept_max_mb * 2**20
    )
    return Recorder(
        Ring(folder, limits),
        RecorderSettings(config.image, config.jpeg_quality, SEGMENT_S, config.keep_before_s, config.keep_after_s),
        clock=lambda: RecordingClock(time.time_ns(), time.monotonic() + virtual_s),
        header=lambda: header(service),
        on_trouble=lambda text: _call_in(loop, service.event_log.warning, text),
    )


class RecordingSink(Protocol):
    """Takes the values to be recorded: a `Recorder`, or another consumer."""

    @property
    def records_images(self) -> bool: ...

    def add(self, value: RecordedFrame | RecordedCycle | RecordedMessage) -> None: ...


class RecordingObserver:
    """Passes frames and decisions of a service to a recorder; takes microseconds."""

    def __init__(self, recorder: RecordingSink) -> None:
        self._recorder = recorder
        self._idle = True
        self._slipping = False
        self._faulty = False
        self._image_at_s: dict[str, float] = {}

    def add_frame(self, finger: str, processed: ProcessedFrame) -> None:
        """Record a frame of a finger and its result; the image is mostly left out while nothing is held or touched."""
        frame, estimate = processed.frame, processed.estimate
        uneventful = self._idle and estimate is not None and not estimate.contact
        recent = frame.captured_at_s - self._image_at_s.get(finger, float("-inf")) < IDLE_IMAGE_S
        with_image = self._recorder.records_images and not (uneventful and recent)
        if with_image:
            self._image_at_s[finger] = frame.captured_at_s
        record = m.FrameRecord(
            frame.sequence,
            frame.captured_at_s,
            processed.new_reference,
            processed.new_pipeline,
            estimate,
            processed.refused,
        )
        segmented = estimate is not None and estimate.skipped is None and estimate.segmented
        patch = processed.patch if segmented else None
        self._recorder.add(
            RecordedFrame(
                finger,
                processed.processed_at_s,
                record,
                frame.image if with_image else None,
                patch.full_mask() if patch is not None else None,
            )
        )

    def add_decision(self, decision: Decision) -> None:
        """Record a cycle of the loop; the files around the beginning of a slip or a fault are kept."""
        grasp = decision.state_before.grasp
        slipping, faulty = grasp.held.slip is not None, decision.output.fault is not None
        keep = (slipping and not self._slipping) or (faulty and not self._faulty)
        self._slipping, self._faulty = slipping, faulty
        self._idle = decision.phase is Phase.IDLE
        estimates = decision.estimates
        record = m.CycleRecord(
            decision.now_s,
            decision.phase.value,
            decision.observation,
            decision.output,
            _sequence(estimates.get("left")),
            _sequence(estimates.get("right")),
        )
        self._recorder.add(RecordedCycle(record, decision.state_before, keep))


async def record(
    service: Service,
    recorder: Recorder,
    make_observer: Callable[[RecordingSink], RecordingObserver] = RecordingObserver,
) -> None:
    """Record until cancelled; then write the waiting values and close the file."""
    with (
        observed(service, make_observer(recorder)),
        service.event_log.listeners.attached(lambda event: recorder.add(_as_message(event))),
    ):
        recorder.start()
        try:
            await asyncio.get_running_loop().create_future()
        finally:
            await asyncio.to_thread(recorder.stop, STOP_S)


@contextlib.contextmanager
def observed(service: Service, observer: RecordingObserver) -> Iterator[None]:
    """Pass each frame and each decision of a service to an observer."""
    with contextlib.ExitStack() as attached:
        for name, finger in service.fingers.items():
            attached.enter_context(finger.observers.attached(partial(observer.add_frame, name)))
        attached.enter_context(service.observers.attached(observer.add_decision))
        yield


def _as_message(event: Event) -> RecordedMessage:
    return RecordedMessage(event.at_s, event.line, event.level == "fault")


def _sequence(estimate: Estimate | None) -> int | None:
    return None if estimate is None else estimate.sequence


def header(service: Service) -> RecordingHeader:
    """Return the header of a recording: versions, configuration, and each finger's background image."""
    model = service.config.perception.model or default_model_path()
    facts = {"slipguard": __version__, "model_sha256": hashlib.sha256(model.read_bytes()).hexdigest()}
    attachments = {m.CONFIG_ATTACHMENT: config_json(service.config)}
    for name, finger in service.fingers.items():
        if finger.serial is None:
            continue
        facts[f"{name}.serial"] = finger.serial
        try:
            known = service.store.load_background(finger.serial)
        except InputError:
            known = None
        if known is not None:
            facts[f"{name}.noise_bgr"] = json.dumps(known.noise_bgr)
            attachments[m.background_name(name)] = cv2.imencode(".png", known.image)[1].tobytes()
    return RecordingHeader(facts, attachments)


def config_json(config: Config) -> bytes:
    """Return the configuration with all defaults and the drivers' tables."""
    return config.model_dump_json(indent=2, serialize_as_any=True).encode()


def _call_in(loop: asyncio.AbstractEventLoop, receive: Callable[[str], None], text: str) -> None:
    """Call from the recorder's thread into the loop; do nothing once the loop is closed."""
    with contextlib.suppress(RuntimeError):
        loop.call_soon_threadsafe(receive, text)
