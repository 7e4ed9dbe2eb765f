"""A daemon API for tests: records the submitted requests, and refuses or fails on demand."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import asynccontextmanager, closing
from pathlib import Path
from typing import Any

import numpy as np

from slipguard.control.finger_fusion import FusedEstimate
from slipguard.daemon.api.daemon_api import ContactOverlay, DaemonApi, FingerFrame
from slipguard.daemon.api.handlers import calibration_response
from slipguard.daemon.api.requests import CalibrateRequest, DaemonRequest
from slipguard.daemon.api.state import Limits, RecordingState, RoundTrips, State
from slipguard.daemon.loop.event_log import Event
from slipguard.daemon.store.background_images import BackgroundImage
from slipguard.devices import FINGERS, Frame, GripperState
from slipguard.perception.patch import ClippedSides
from slipguard.web.access import Access
from slipguard.web.route_context import RouteContext
from slipguard.web.serve import serve
from slipguard.web.sockets import bind, bind_tcp

TOKEN = "f" * 64


def holding_state(**changed: Any) -> State:
    """Return the state of a cell that holds an object with 40 N, with these fields changed."""
    fields: dict[str, Any] = {
        "version": "0.1.0",
        "now_s": 12.5,
        "mode": "lift",
        "config_problem": None,
        "phase": "holding",
        "guarding": True,
        "slipping": False,
        "putting_down": False,
        "stopped_by_request": False,
        "target_force_n": 40.0,
        "limits": Limits(first_force_n=40.0, force_max_n=130.0, rotation_max_deg=45.0, lift_height_mm=100.0),
        "no_rotation_reason": None,
        "fault": None,
        "rotation": FusedEstimate(True, True, 12.4, 12.4, FINGERS, 1.5, 0.25, newest_at_s=12.4),
        "gripper": GripperState(True, False, True, False, 60.0, 40.25, None, 12.4),
        "arm": None,
        "has_arm": True,
        "lifted_mm": None,
        "fingers": {},
        "devices": {},
        "round_trips": RoundTrips(gripper=None, arm=None),
        "latency": None,
        "waiting_for": [],
        "deadlines_missed": 0,
        "events": [Event(1.0, "info", "gripped")],
        "last_slip": None,
        "recording": RecordingState(),
    }
    return State.model_validate(fields | changed)


class FakeDaemonApi(DaemonApi):
    """requests: those submitted. failure: raised by every method from now on. delay_s: duration of a request."""

    def __init__(self) -> None:
        self.requests: list[DaemonRequest] = []
        self.failure: Exception | None = None
        self.problem: str | None = None
        self.delay_s = 0.0
        self.frames = 0
        self.state_calls = 0
        self.started = asyncio.Event()
        self.subscribers: list[Callable[[Event], None]] = []
        self.events: list[Event] = [Event(1.0, "info", "gripped")]
        self.present = holding_state()
        self.estimate_subscribers: list[Callable[[bytes], None]] = []

    def snapshot(self) -> dict[str, Any]:
        """Return the state as the API shows it."""
        return self.present.model_dump(mode="json")

    async def state(self) -> bytes:
        self.state_calls += 1
        return self.present.model_dump_json().encode()

    async def health_problem(self) -> str | None:
        return self.problem

    async def counters(self) -> bytes:
        return b"{}"

    async def frame(self, finger: str, after: int | None = None) -> FingerFrame:
        if self.failure is not None:
            raise self.failure
        image = np.random.default_rng(self.frames).integers(0, 256, (320, 240, 3), np.uint8)
        self.frames += 1
        return FingerFrame(f"D2000{1 + (finger == 'right')}", Frame(image, 12.25, self.frames))

    async def processed_frame(self, finger: str) -> FingerFrame:
        if self.failure is not None:
            raise self.failure
        self.frames += 1
        mask = np.zeros((60, 40), np.uint8)
        mask[5:55, 15:25] = 1
        contact = ContactOverlay(mask, 50, 60, (160, 213), ClippedSides(), 90.0)
        return FingerFrame("D20001", Frame(np.full((320, 240, 3), 90, np.uint8), 12.25, self.frames), contact)

    async def submit(self, request: DaemonRequest, deadline_s: float | None = None) -> Mapping[str, object]:
        self.requests.append(request)
        self.started.set()
        await asyncio.sleep(self.delay_s)
        if self.failure is not None:
            raise self.failure
        if isinstance(request, CalibrateRequest):
            image = np.full((320, 240, 3), 90, np.uint8)
            return calibration_response({name: BackgroundImage(image, (2.9, 1.5, 2.4), 30) for name in FINGERS})
        return {"message": f"{request.kind}: done"}

    async def backgrounds(self) -> bytes:
        fields = {
            "created_at": "2026-11-20T12:00:00+00:00",
            "noise_bgr": [2.9, 1.5, 2.4],
            "level_bgr": [90.0, 91.0, 92.0],
            "frames": 30,
            "new_gel": False,
            "copy_of": None,
        }
        versions = [{"number": number} | fields for number in (1, 2)]
        return json.dumps(
            {name: {"serial": f"SIM-{name[0].upper()}", "versions": versions} for name in FINGERS}
        ).encode()

    async def background(self, finger: str, number: int | None = None) -> FingerFrame:
        if self.failure is not None:
            raise self.failure
        image = np.full((320, 240, 3), 90 + (number or 2) % 100, np.uint8)
        return FingerFrame(f"SIM-{finger[0].upper()}", Frame(image, 0.0, number or 2))

    def subscribe(self, on_event: Callable[[Event], None]) -> Callable[[], None]:
        for event in self.events:
            on_event(event)
        self.subscribers.append(on_event)
        return lambda: self.subscribers.remove(on_event)

    def subscribe_estimates(self, on_estimates: Callable[[bytes], None]) -> Callable[[], None]:
        self.estimate_subscribers.append(on_estimates)
        return lambda: self.estimate_subscribers.remove(on_estimates)


@asynccontextmanager
async def served(daemon: FakeDaemonApi, path: Path) -> AsyncIterator[Path]:
    """Serve the API on a real Unix socket during the block."""
    with closing(bind(path)) as unix:
        serving = asyncio.create_task(serve(RouteContext(daemon), unix.listening), name="api")
        try:
            await first_response(serving, path)
            yield path
        finally:
            serving.cancel()
            await asyncio.gather(serving, return_exceptions=True)


@asynccontextmanager
async def served_on_tcp(daemon: FakeDaemonApi, folder: Path) -> AsyncIterator[tuple[int, Access]]:
    """Serve the API on a TCP port as well; provides the port and its access control."""
    with closing(bind(folder / "s")) as unix, closing(bind_tcp("127.0.0.1", 0)) as tcp:
        port = int(tcp.getsockname()[1])
        access = Access(TOKEN, ("127.0.0.1", port))
        serving = asyncio.create_task(serve(RouteContext(daemon, access), unix.listening, tcp), name="api")
        try:
            await first_response(serving, folder / "s")
            yield port, access
        finally:
            serving.cancel()
            await asyncio.gather(serving, return_exceptions=True)


async def first_response(serving: asyncio.Task[None], path: Path) -> None:
    """Wait for the first response: the sockets listen before the server is ready."""
    reader, writer = await asyncio.open_unix_connection(path)
    writer.write(b"GET /access HTTP/1.1\r\nhost: slipguard\r\nconnection: close\r\n\r\n")
    response = asyncio.create_task(reader.read(), name="first response")
    await asyncio.wait((response, serving), return_when=asyncio.FIRST_COMPLETED)
    writer.close()
    await writer.wait_closed()
    if not response.done():
        response.cancel()
        await serving
        raise AssertionError("the server stopped")
