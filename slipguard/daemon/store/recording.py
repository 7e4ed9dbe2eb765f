"""What of the running service is recorded, and when it is worth keeping."""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import json
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Protocol, TypeVar

import cv2

from slipguard import __version__
from slipguard.config import Config
from slipguard.control.state import Phase
from slipguard.daemon.loop.decision import Decision
from slipguard.daemon.loop.event_log import Event
from slipguard.daemon.loop.finger import ProcessedFrame
from slipguard.daemon.loop.service import Service
from slipguard.errors import InputError
from slipguard.perception.contact.segmenter import default_model_path
from slipguard.perception.estimate import Estimate
from slipguard.recording import messages as m
from slipguard.recording.recorder import RecordedCycle, RecordedFrame, RecordedMessage, Recorder, RecorderSettings
from slipguard.recording.ring import Ring, RingLimits
from slipguard.recording.writer import RecordingClock, RecordingHeader

SEGMENT_S = 20.0
IDLE_IMAGE_S = 1.0
"""With nothing held and nothing touched, one picture in this time is enough."""
STOP_S = 5.0
T = TypeVar("T")


def make_recorder(service: Service, folder: Path) -> Recorder:
    """A recorder for a service, into `folder`; not yet started."""
    asked = service.config.recording
    loop = asyncio.get_running_loop()
    virtual_s = loop.time() - time.monotonic()
    # That is 0, but for a virtual clock: by it each file goes on where the one before ended.
    limits = RingLimits(max(round(asked.ring_s / SEGMENT_S), 1), asked.ring_max_mb * 2**20, asked.kept_max_mb * 2**20)
    return Recorder(
        Ring(folder, limits),
        RecorderSettings(asked.image, asked.jpeg_quality, SEGMENT_S, asked.keep_before_s, asked.keep_after_s),
        clock=lambda: RecordingClock(time.time_ns(), time.monotonic() + virtual_s),
        header=lambda: header(service),
        on_trouble=lambda text: _say_in(loop, service.event_log.warning, text),
    )


async def record(
    service: Service, recorder: Recorder, make_watcher: Callable[[RecordingSink], RecordingObserver] | None = None
) -> None:
    """Record until cancelled; then what waits is written and the file is closed."""
    watcher = (make_watcher or RecordingObserver)(recorder)
    loop = asyncio.get_running_loop()
    with contextlib.ExitStack() as watched:
        for name, finger in service.fingers.items():
            judged: Callable[[ProcessedFrame], None] = partial(watcher.judged, name)
            _attach(watched, finger.observers, judged)
        _attach(watched, service.observers, watcher.decided)
        _attach(watched, service.event_log.listeners, lambda event: recorder.hand(_recorded_message(event)))
        recorder.start()
        try:
            await loop.create_future()
        finally:
            await asyncio.to_thread(recorder.stop, STOP_S)


def _recorded_message(event: Event) -> RecordedMessage:
    return RecordedMessage(event.at_s, event.line, event.level == "fault")


def _attach(watched: contextlib.ExitStack, observers: list[T], observer: T) -> None:
    observers.append(observer)
    watched.callback(observers.remove, observer)


class RecordingSink(Protocol):
    """Who records: a `Recorder`, or whatever else takes what it is handed."""

    @property
    def takes_pictures(self) -> bool: ...

    def hand(self, value: RecordedFrame | RecordedCycle | RecordedMessage) -> None: ...


class RecordingObserver:
    """Hands over what the loop and the fingers tell; costs them some microseconds."""

    def __init__(self, recorder: RecordingSink) -> None:
        self._recorder = recorder
        self._idle = True
        self._slipping = False
        self._faulty = False
        self._pictured_s: dict[str, float] = {}

    def judged(self, finger: str, processed: ProcessedFrame) -> None:
        """A finger's frame and what it says; without its picture while nothing is going on."""
        frame, estimate = processed.frame, processed.estimate
        boring = self._idle and estimate is not None and not estimate.contact
        recent = frame.captured_at_s - self._pictured_s.get(finger, float("-inf")) < IDLE_IMAGE_S
        pictured = self._recorder.takes_pictures and not (boring and recent)
        if pictured:
            self._pictured_s[finger] = frame.captured_at_s
        told = m.FrameRecord(
            frame.sequence,
            frame.captured_at_s,
            processed.new_reference,
            processed.new_pipeline,
            estimate,
            processed.refused,
        )
        patch = processed.patch if estimate is not None and estimate.skipped is None else None
        self._recorder.hand(
            RecordedFrame(
                finger,
                processed.processed_at_s,
                told,
                frame.image if pictured else None,
                patch.full_mask() if patch is not None else None,
            )
        )

    def decided(self, decision: Decision) -> None:
        """A turn of the loop; the beginning of a slip or a fault is worth keeping."""
        grasp = decision.memory.grasp
        slipping, faulty = grasp.slip is not None, decision.command.fault is not None
        keep = (slipping and not self._slipping) or (faulty and not self._faulty)
        self._slipping, self._faulty = slipping, faulty
        self._idle = decision.phase is Phase.IDLE
        estimates = decision.estimates
        tick = m.CycleRecord(
            decision.now_s,
            decision.phase.value,
            decision.observation,
            decision.command,
            _sequence(estimates.get("left")),
            _sequence(estimates.get("right")),
        )
        self._recorder.hand(RecordedCycle(tick, decision.memory, keep))


def _sequence(estimate: Estimate | None) -> int | None:
    return None if estimate is None else estimate.sequence


def header(service: Service) -> RecordingHeader:
    """Versions, the whole configuration, and each finger's no-contact image."""
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
    """The configuration with every default spelled out, drivers' tables too."""
    return config.model_dump_json(indent=2, serialize_as_any=True).encode()


def _say_in(loop: asyncio.AbstractEventLoop, say: Callable[[str], None], text: str) -> None:
    """From the recorder's thread into the loop; nothing once the loop is closed."""
    with contextlib.suppress(RuntimeError):
        loop.call_soon_threadsafe(say, text)
