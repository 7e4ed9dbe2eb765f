"""Handles requests from the local API: reads the running service and passes requests to its controller."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import json
from collections.abc import AsyncIterator, Callable, Mapping
from functools import partial

from pydantic_core import to_json

from slipguard.control.messages import ControlRequest, RequestKind
from slipguard.daemon.api.background_capture import BackgroundCapture
from slipguard.daemon.api.daemon_api import NEXT_FRAME_TIMEOUT_S, ContactOverlay, DaemonApi, FingerFrame
from slipguard.daemon.api.requests import (
    EXECUTE_WITHIN_S,
    ActivateRequest,
    CalibrateRequest,
    DaemonRequest,
    GraspRequest,
    GuardRequest,
    LiftRequest,
    MoveJawsRequest,
    RestoreBackgroundRequest,
)
from slipguard.daemon.api.snapshot import health_problem, snapshot
from slipguard.daemon.api.state import NewEstimates, RecordingState, State
from slipguard.daemon.loop.decision import Decision
from slipguard.daemon.loop.event_log import Event
from slipguard.daemon.loop.finger import Finger, ProcessedFrame
from slipguard.daemon.loop.gel_monitor import GelMonitor
from slipguard.daemon.loop.loop_metrics import LoopMetrics
from slipguard.daemon.loop.service import Service
from slipguard.daemon.store.background_images import BackgroundImage
from slipguard.devices import Frame
from slipguard.errors import CommandRefused
from slipguard.perception.axis import wrap_axial_deg
from slipguard.recording.recorder import Recorder

NOT_WITH_OLD_CONFIG = (GraspRequest, LiftRequest, ActivateRequest, MoveJawsRequest)
"""Refused while the configuration file is not valid and the last valid one is in use."""
ACTIVATED_WITHIN_S = 15.0
"""A 2F-85 takes about 3 s."""
ACTIVATION_POLL_S = 0.05


class RequestHandlers(DaemonApi):
    """The API of one service. Methods raise CommandRefused with the reason."""

    def __init__(self, service: Service, gels: GelMonitor | None = None) -> None:
        self._service, self._gels = service, gels
        self._capture = BackgroundCapture(service)
        self._recorder: Recorder | None = None
        self._metrics = LoopMetrics(service)
        self._processed: dict[str, ProcessedFrame] = {}
        for name, finger in service.fingers.items():
            finger.observers.append(partial(self._processed.__setitem__, name))

    async def state(self) -> bytes:
        return self.snapshot().model_dump_json().encode()

    def snapshot(self) -> State:
        """Return the complete state; does not wait."""
        gels = {} if self._gels is None else self._gels.conditions
        return snapshot(self._service, gels, self._recording_state())

    def watch_recorder(self, recorder: Recorder) -> None:
        """Let the state report on this recorder from now on."""
        self._recorder = recorder

    def _recording_state(self) -> RecordingState:
        recorder = self._recorder
        if recorder is None or not self._service.config.recording.enabled:
            return RecordingState()
        why = recorder.stopped or ("the recorder thread has ended; restart the daemon" if recorder.dead else None)
        return RecordingState(state="on" if why is None else "stopped", why=why, left_out=recorder.left_out)

    async def health_problem(self) -> str | None:
        return health_problem(self._service)

    async def counters(self) -> bytes:
        return json.dumps(self._metrics.as_dict()).encode()

    async def frame(self, finger: str, after: int | None = None) -> FingerFrame:
        one = self._finger(finger)
        newest = one.capture.newest_frame
        if newest is not None and newest.sequence == after:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(NEXT_FRAME_TIMEOUT_S):
                    await one.capture.frame_arrived.wait()
            newest = one.capture.newest_frame
        if newest is None or one.serial is None:
            raise CommandRefused(f"no frame of the {finger} finger: {one.health.reason}")
        if newest.sequence == after:
            raise CommandRefused(f"no new frame of the {finger} finger for {NEXT_FRAME_TIMEOUT_S:g} s")
        return FingerFrame(one.serial, newest)

    def _finger(self, name: str) -> Finger:
        fingers = self._service.fingers
        if name not in fingers:
            raise CommandRefused(f"no finger {name!r}; choose from: {', '.join(fingers)}")
        return fingers[name]

    async def processed_frame(self, finger: str) -> FingerFrame:
        serial = (await self.frame(finger)).serial
        processed = self._processed.get(finger)
        if processed is None:
            raise CommandRefused(f"no frame of the {finger} finger has been processed yet; try again in a second")
        return FingerFrame(serial, processed.frame, self._contact(finger, processed))

    def _contact(self, finger: str, processed: ProcessedFrame) -> ContactOverlay | None:
        patch, estimate = processed.patch, processed.estimate
        if patch is None or estimate is None or not estimate.contact:
            return None
        orientation_deg, mounting_deg = estimate.orientation_deg, getattr(self._service.config, finger).mounting_deg
        axis_deg = None if orientation_deg is None else wrap_axial_deg(orientation_deg - mounting_deg)
        return ContactOverlay(patch.mask, patch.left_px, patch.top_px, patch.image_size, patch.clipped, axis_deg)

    async def submit(self, request: DaemonRequest, deadline_s: float | None = None) -> Mapping[str, object]:
        loop = asyncio.get_running_loop()
        deadline_s = loop.time() + EXECUTE_WITHIN_S if deadline_s is None else deadline_s
        problem = self._service.config_problem
        if problem is not None and isinstance(request, NOT_WITH_OLD_CONFIG):
            raise CommandRefused(f"cannot {request.kind}: {problem}")
        match request:
            case CalibrateRequest():
                return calibration_response(await self.calibrate(request))
            case ActivateRequest():
                return {"message": await self._activate(request, deadline_s)}
            case RestoreBackgroundRequest():
                return {"message": await self._capture.restore(request)}
            case GraspRequest():
                waiting = self._service.waiting_for
                if waiting:
                    raise CommandRefused(f"cannot grasp: not ready: {'; '.join(waiting)}")
                self._capture.check_not_running()
                async with _in_time(deadline_s, "grasp"):
                    await self._capture.check_calibrated()
            case MoveJawsRequest():
                self._capture.check_not_running()
        return {"message": await self._service.request(controller_request(request), deadline_s)}

    async def _activate(self, request: ActivateRequest, deadline_s: float) -> str:
        """Activate the gripper and wait until it is active; return a message."""
        self._capture.check_not_running()
        async with _in_time(deadline_s, "activate"):
            reason = None if request.force else await self._capture.may_hold_reason()
        if reason is not None:
            raise CommandRefused(
                f"cannot activate: {reason}, and the jaws would close on a held object and drop it; support it, then "
                "release it, and check the sensors. Use --force only if the jaws are empty, with the gels covered"
            )
        await self._service.request(controller_request(request), deadline_s)
        return await self._wait_until_active()

    async def _wait_until_active(self) -> str:
        """Return a message when the gripper is active. Raises CommandRefused if that fails."""
        loop, gripper = asyncio.get_running_loop(), self._service.gripper
        requested_s = loop.time()
        while loop.time() - requested_s < ACTIVATED_WITHIN_S:
            await asyncio.sleep(ACTIVATION_POLL_S)
            newest = gripper.newest
            if newest is not None and newest.active and newest.measured_at_s > requested_s:
                return f"the gripper is activated; the jaws are {newest.width_mm:.0f} mm apart"
            if not gripper.health.ready and not gripper.commanding:
                raise CommandRefused(f"the activation failed: {gripper.health.message}")
        raise CommandRefused(
            f"not activated within {ACTIVATED_WITHIN_S:g} s; the jaws may still move. See `slipguard ctl state` and "
            "the log"
        )

    async def calibrate(self, request: CalibrateRequest) -> dict[str, BackgroundImage]:
        """Take and store the background images of both fingers; return them by finger."""
        return await self._capture.calibrate(request)

    async def backgrounds(self) -> bytes:
        return to_json(await self._capture.versions())

    async def background(self, finger: str, number: int | None = None) -> FingerFrame:
        serial, found, stored = await self._capture.find(self._finger(finger), number)
        return FingerFrame(serial, Frame(stored.image, 0.0, found))

    def subscribe(self, on_event: Callable[[Event], None]) -> Callable[[], None]:
        event_log = self._service.event_log
        for event in event_log.events:
            on_event(event)
        event_log.listeners.append(on_event)
        return lambda: event_log.listeners.remove(on_event)

    def subscribe_estimates(self, on_estimates: Callable[[bytes], None]) -> Callable[[], None]:
        numbers = itertools.count()

        def add_decision(decision: Decision) -> None:
            if decision.new_estimates:
                new = NewEstimates(
                    number=next(numbers),
                    at_s=decision.now_s,
                    rotation=decision.observation.fused,
                    fingers=dict(decision.new_estimates),
                )
                on_estimates(new.model_dump_json().encode())

        self._service.observers.append(add_decision)
        return lambda: self._service.observers.remove(add_decision)


@contextlib.asynccontextmanager
async def _in_time(deadline_s: float, verb: str) -> AsyncIterator[None]:
    """Raise CommandRefused if the block, which reads stored images, takes too long."""
    try:
        async with asyncio.timeout_at(deadline_s):
            yield
    except TimeoutError:
        raise CommandRefused(
            f"cannot {verb}: the background images were not read within {EXECUTE_WITHIN_S:g} s; check the disk"
        ) from None


def controller_request(request: DaemonRequest) -> ControlRequest:
    """Convert a request of the API to the controller's form."""
    kind = request.kind
    if isinstance(request, GuardRequest):
        kind = "guard on" if request.on else "guard off"
    return ControlRequest(RequestKind(kind), **request.model_dump(exclude={"on", "confirm", "force"}))


def calibration_response(taken: Mapping[str, BackgroundImage]) -> dict[str, object]:
    """Return the response to a calibration: properties of the new background images, by finger."""
    fingers = {
        name: {
            "frames": one.frames,
            "noise_bgr": [round(level, 2) for level in one.noise_bgr],
            "level_bgr": [round(float(level), 1) for level in one.image.mean(axis=(0, 1))],
        }
        for name, one in taken.items()
    }
    return {"message": f"background images of {' and '.join(taken)} stored", "fingers": fingers}
