"""A daemon API for tests: records the submitted requests, and refuses or fails on demand."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import asynccontextmanager, closing
from dataclasses import asdict
from pathlib import Path

import numpy as np

from slipguard.daemon.api.daemon_api import ContactOverlay, DaemonApi, FingerFrame
from slipguard.daemon.api.handlers import calibration_response
from slipguard.daemon.api.requests import CalibrateRequest, DaemonRequest
from slipguard.daemon.loop.event_log import Event
from slipguard.daemon.store.background_images import BackgroundImage
from slipguard.devices import FINGERS, Frame, GripperState
from slipguard.perception.patch import ClippedSides
from slipguard.web.access import Access
from slipguard.web.route_context import RouteContext
from slipguard.web.serve import serve
from slipguard.web.sockets import bind, bind_tcp

TOKEN = "f" * 64


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

    def snapshot(self) -> dict[str, object]:
        return {
            "version": "0.1.0",
            "now_s": 12.5,
            "phase": "holding",
            "mode": "lift",
            "guarding": True,
            "slipping": False,
            "stopped_by_request": False,
            "target_force_n": 40.0,
            "fault": None,
            "rotation": {"rotation_deg": 1.5, "sigma_deg": 0.25},
            "gripper": asdict(GripperState(True, False, True, False, 60.0, 40.25, None, 12.4)),
            "arm": None,
            "has_arm": True,
            "fingers": {},
            "devices": {},
            "waiting_for": [],
            "deadlines_missed": 0,
            "events": [{"at_s": 1.0, "level": "info", "text": "gripped"}],
        }

    async def state(self) -> bytes:
        self.state_calls += 1
        return json.dumps(self.snapshot()).encode()

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
