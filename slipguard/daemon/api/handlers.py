"""Answers what the local API asks, from the running service."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

from slipguard.daemon.api.controls import Controls
from slipguard.daemon.api.daemon_api import ContactOverlay, DaemonApi, FingerFrame
from slipguard.daemon.loop.event_log import Event
from slipguard.daemon.loop.finger import ProcessedFrame
from slipguard.daemon.loop.loop_metrics import LoopMetrics
from slipguard.daemon.loop.service import Service
from slipguard.daemon.store.background_history import history, stored_image
from slipguard.daemon.store.calibration import BackgroundImage
from slipguard.devices import Frame
from slipguard.errors import CommandRefused
from slipguard.perception.rotation.axial_angle import wrap_axial_deg
from slipguard.recording.recorder import Recorder
from slipguard.thread_priority import set_worker_priority


class RequestHandlers(DaemonApi):
    """One service's."""

    def __init__(self, service: Service) -> None:
        self._service = service
        self._controls = Controls(service)
        self._recorder: Recorder | None = None
        self._metrics = LoopMetrics(service)
        # One thread of its own: whoever looks at stored images keeps neither frames nor the gripper waiting.
        self._reading = ThreadPoolExecutor(1, "slipguard-images", initializer=set_worker_priority)
        self._judged: dict[str, ProcessedFrame] = {}
        for name, finger in service.fingers.items():
            finger.observers.append(partial(self._judged.__setitem__, name))

    async def state(self) -> bytes:
        """Everything there is to know now, as a JSON object."""
        return json.dumps(self._controls.snapshot() | {"recording": self._recording()}).encode()

    def noting(self, make: Callable[[Service, Path], Recorder]) -> Callable[[Service, Path], Recorder]:
        """`make`, with the newest recorder it made being told of."""

        def made(service: Service, folder: Path) -> Recorder:
            self._recorder = make(service, folder)
            return self._recorder

        return made

    def _recording(self) -> dict[str, object]:
        recorder = self._recorder
        if recorder is None or not self._service.config.recording.enabled:
            return {"state": "off", "why": None, "left_out": 0}
        why = recorder.stopped or ("the thread that records has ended; restart the daemon" if recorder.dead else None)
        return {"state": "on" if why is None else "stopped", "why": why, "left_out": recorder.left_out}

    async def trouble(self) -> str | None:
        """Why the service is not well, in one line; None if it is."""
        return self._controls.trouble()

    async def tallies(self) -> bytes:
        """What was counted and timed since the start."""
        return json.dumps(self._metrics.as_dict()).encode()

    async def frame(self, finger: str) -> FingerFrame:
        """Serial number and newest frame of a finger."""
        return FingerFrame(*self._controls.frame(finger))

    async def view(self, finger: str) -> FingerFrame:
        """The newest judged frame and the contact in it; none of a sensor that is gone."""
        serial, _ = self._controls.frame(finger)
        judged = self._judged.get(finger)
        if judged is None:
            raise CommandRefused(f"no frame of the {finger} finger was judged yet; ask again in a second")
        return FingerFrame(serial, judged.frame, self._contact(finger, judged))

    def _contact(self, finger: str, judged: ProcessedFrame) -> ContactOverlay | None:
        patch, estimate = judged.patch, judged.estimate
        if patch is None or estimate is None or not estimate.contact:
            return None
        told_deg, mounted_deg = estimate.orientation_deg, getattr(self._service.config, finger).mounting_deg
        axis_deg = None if told_deg is None else wrap_axial_deg(told_deg - mounted_deg)
        return ContactOverlay(patch.mask, patch.left_px, patch.top_px, patch.image_size, patch.clipped, axis_deg)

    async def grasp(self, force_n: float | None = None) -> str:
        return await self._controls.grasp(force_n)

    async def lift(self, height_mm: float | None = None, speed_mm_s: float | None = None) -> str:
        return await self._controls.lift(height_mm, speed_mm_s)

    async def lower(self, height_mm: float | None = None, speed_mm_s: float | None = None) -> str:
        return await self._controls.lower(height_mm, speed_mm_s)

    async def guard(self, on: bool) -> str:
        return await self._controls.guard(on)

    async def gripper(self, width_mm: float | None = None, force_n: float | None = None) -> str:
        return await self._controls.gripper(width_mm, force_n)

    async def release(self, width_mm: float | None = None) -> str:
        return await self._controls.release(width_mm)

    async def clear(self) -> str:
        return await self._controls.clear()

    async def calibrate(self, force: bool = False, new_gel: bool = False) -> Mapping[str, object]:
        """Take both no-contact images; `said`, and by finger what they are like."""
        return calibration_answer(await self._controls.calibrate(force=force, new_gel=new_gel))

    async def go_back(self, finger: str, number: int) -> str:
        return await self._controls.go_back(finger, number)

    async def no_contacts(self) -> bytes:
        """What is stored of each finger's sensor."""
        return json.dumps(await history(self._service, self._reading)).encode()

    async def no_contact(self, finger: str, number: int | None = None) -> FingerFrame:
        """A stored no-contact image."""
        serial, found, image = await stored_image(self._service, self._reading, finger, number)
        return FingerFrame(serial, Frame(image, 0.0, found))

    def listen(self, hear: Callable[[Event], None]) -> Callable[[], None]:
        """Tell the newest events, and from then on each as it happens."""
        event_log = self._service.event_log
        for event in event_log.events:
            hear(event)
        event_log.listeners.append(hear)
        return lambda: event_log.listeners.remove(hear)


def calibration_answer(taken: Mapping[str, BackgroundImage]) -> dict[str, object]:
    """What a calibration says of the images it took, by finger."""
    fingers = {
        name: {
            "frames": one.frames,
            "noise_bgr": [round(level, 2) for level in one.noise_bgr],
            "level_bgr": [round(float(level), 1) for level in one.image.mean(axis=(0, 1))],
        }
        for name, one in taken.items()
    }
    return {"said": f"no-contact images of {' and '.join(taken)} stored", "fingers": fingers}
