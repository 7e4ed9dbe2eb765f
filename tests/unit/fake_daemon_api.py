"""A daemon for the API to talk to: remembers what was asked, and refuses or breaks on demand."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import asynccontextmanager, closing
from dataclasses import asdict
from pathlib import Path

import numpy as np

from slipguard.daemon.api.daemon_api import ContactOverlay, DaemonApi, FingerFrame
from slipguard.daemon.api.handlers import calibration_answer
from slipguard.daemon.loop.event_log import Event
from slipguard.daemon.store.calibration import BackgroundImage
from slipguard.devices import Frame, GripperState
from slipguard.perception.contact.patch import ClippedSides
from slipguard.web.access import Access
from slipguard.web.images import FINGERS
from slipguard.web.route_context import RouteContext
from slipguard.web.serve import serve
from slipguard.web.sockets import bind, bind_tcp

TOKEN = "f" * 64


class FakeDaemonApi(DaemonApi):
    def __init__(self) -> None:
        self.asked: list[tuple[object, ...]] = []
        self.failure: Exception | None = None
        self.why: str | None = None
        self.delay_s = 0.0
        self.frames = 0
        self.looked = 0
        self.began = asyncio.Event()
        self.ears: list[Callable[[Event], None]] = []
        self.events: list[Event] = [Event(1.0, "info", "gripped")]

    async def _note(self, *what: object) -> str:
        self.asked.append(what)
        self.began.set()
        await asyncio.sleep(self.delay_s)
        if self.failure is not None:
            raise self.failure
        return f"{what[0]}, as asked"

    def snapshot(self) -> dict[str, object]:
        """What the state is made of."""
        return {
            "version": "0.1.0",
            "now_s": 12.5,
            "phase": "holding",
            "mode": "lift",
            "guarding": True,
            "slipping": False,
            "target_force_n": 40.0,
            "fault": None,
            "rotation": {"rotation_deg": 1.5, "sigma_deg": 0.25},
            "gripper": asdict(GripperState(True, False, True, False, 60.0, 40.25, None, 12.4)),
            "arm": None,
            "fingers": {},
            "devices": {},
            "waiting_for": [],
            "deadlines_missed": 0,
            "said": ["gripped", "holding"],
        }

    async def state(self) -> bytes:
        self.looked += 1
        return json.dumps(self.snapshot()).encode()

    async def trouble(self) -> str | None:
        return self.why

    async def tallies(self) -> bytes:
        return b"{}"

    async def frame(self, finger: str) -> FingerFrame:
        if self.failure is not None:
            raise self.failure
        image = np.random.default_rng(self.frames).integers(0, 256, (320, 240, 3), np.uint8)
        self.frames += 1
        return FingerFrame(f"D2000{1 + (finger == 'right')}", Frame(image, 12.25, self.frames))

    async def view(self, finger: str) -> FingerFrame:
        if self.failure is not None:
            raise self.failure
        self.frames += 1
        mask = np.zeros((60, 40), np.uint8)
        mask[5:55, 15:25] = 1
        contact = ContactOverlay(mask, 50, 60, (160, 213), ClippedSides(), 90.0)
        return FingerFrame("D20001", Frame(np.full((320, 240, 3), 90, np.uint8), 12.25, self.frames), contact)

    async def grasp(self, force_n: float | None = None) -> str:
        return await self._note("grasp", force_n)

    async def lift(self, height_mm: float | None = None, speed_mm_s: float | None = None) -> str:
        return await self._note("lift", height_mm, speed_mm_s)

    async def lower(self, height_mm: float | None = None, speed_mm_s: float | None = None) -> str:
        return await self._note("lower", height_mm, speed_mm_s)

    async def guard(self, on: bool) -> str:
        return await self._note("guard", on)

    async def gripper(self, width_mm: float | None = None, force_n: float | None = None) -> str:
        return await self._note("gripper", width_mm, force_n)

    async def release(self, width_mm: float | None = None) -> str:
        return await self._note("release", width_mm)

    async def clear(self) -> str:
        return await self._note("clear")

    async def calibrate(self, force: bool = False, new_gel: bool = False) -> Mapping[str, object]:
        await self._note("calibrate", force, *(["new gel"] if new_gel else []))
        image = np.full((320, 240, 3), 90, np.uint8)
        return calibration_answer({name: BackgroundImage(image, (2.9, 1.5, 2.4), 30) for name in ("left", "right")})

    async def go_back(self, finger: str, number: int) -> str:
        return await self._note("go back", finger, number)

    async def no_contacts(self) -> bytes:
        told = {
            "created_at": "2026-11-20T12:00:00+00:00",
            "noise_bgr": [2.9, 1.5, 2.4],
            "level_bgr": [90.0, 91.0, 92.0],
        }
        told |= {"frames": 30, "new_gel": False, "copy_of": None}
        versions = [{"number": number} | told for number in (1, 2)]
        return json.dumps(
            {name: {"serial": f"SIM-{name[0].upper()}", "versions": versions} for name in FINGERS}
        ).encode()

    async def no_contact(self, finger: str, number: int | None = None) -> FingerFrame:
        if self.failure is not None:
            raise self.failure
        picture = np.full((320, 240, 3), 90 + (number or 2) % 100, np.uint8)
        return FingerFrame(f"SIM-{finger[0].upper()}", Frame(picture, 0.0, number or 2))

    def listen(self, hear: Callable[[Event], None]) -> Callable[[], None]:
        for event in self.events:
            hear(event)
        self.ears.append(hear)
        return lambda: self.ears.remove(hear)


@asynccontextmanager
async def served(control: FakeDaemonApi, path: Path) -> AsyncIterator[Path]:
    """The API on a real Unix socket, for as long as the block lasts."""
    with closing(bind(path)) as unix:
        serving = asyncio.create_task(serve(RouteContext(control), unix.listening), name="api")
        try:
            await answering(serving, path)
            yield path
        finally:
            serving.cancel()
            await asyncio.gather(serving, return_exceptions=True)


@asynccontextmanager
async def served_on_tcp(control: FakeDaemonApi, folder: Path) -> AsyncIterator[tuple[int, Access]]:
    """The API on a port of this machine as well; the port and who has access."""
    with closing(bind(folder / "s")) as unix, closing(bind_tcp("127.0.0.1", 0)) as tcp:
        port = int(tcp.getsockname()[1])
        access = Access(TOKEN, ("127.0.0.1", port))
        serving = asyncio.create_task(serve(RouteContext(control, access), unix.listening, tcp), name="api")
        try:
            await answering(serving, folder / "s")
            yield port, access
        finally:
            serving.cancel()
            await asyncio.gather(serving, return_exceptions=True)


async def answering(serving: asyncio.Task[None], path: Path) -> None:
    """Until the first answer; the sockets listen before anybody answers."""
    reader, writer = await asyncio.open_unix_connection(path)
    writer.write(b"GET /access HTTP/1.1\r\nhost: slipguard\r\nconnection: close\r\n\r\n")
    answer = asyncio.create_task(reader.read(), name="first answer")
    await asyncio.wait((answer, serving), return_when=asyncio.FIRST_COMPLETED)
    writer.close()
    await writer.wait_closed()
    if not answer.done():
        answer.cancel()
        await serving
        raise AssertionError("the server ended by itself")
