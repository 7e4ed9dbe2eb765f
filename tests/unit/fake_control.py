"""A daemon for the API to talk to: remembers what was asked, and refuses or breaks on demand."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager
from pathlib import Path

import numpy as np

from slipguard.daemon.api import Control, make_app, serve
from slipguard.daemon.calibration import NoContact
from slipguard.devices import Frame


class FakeControl(Control):
    def __init__(self) -> None:
        self.asked: list[tuple[object, ...]] = []
        self.failure: Exception | None = None
        self.why: str | None = None
        self.delay_s = 0.0
        self.frames = 0
        self.began = asyncio.Event()

    async def _note(self, *what: object) -> str:
        self.asked.append(what)
        self.began.set()
        await asyncio.sleep(self.delay_s)
        if self.failure is not None:
            raise self.failure
        return f"{what[0]}, as asked"

    def snapshot(self) -> Mapping[str, object]:
        return {"phase": "holding", "grip": {"force_n": 40.25}, "fault": None, "said": ["gripped", "holding"]}

    def trouble(self) -> str | None:
        return self.why

    def frame(self, finger: str) -> tuple[str, Frame]:
        if self.failure is not None:
            raise self.failure
        image = np.random.default_rng(self.frames).integers(0, 256, (320, 240, 3), np.uint8)
        self.frames += 1
        return f"D2000{1 + (finger == 'right')}", Frame(image, 12.25, self.frames)

    async def grasp(self, force_n: float | None = None) -> str:
        return await self._note("grasp", force_n)

    async def lift(self, height_mm: float | None = None, speed_mm_s: float | None = None) -> str:
        return await self._note("lift", height_mm, speed_mm_s)

    async def lower(self, height_mm: float | None = None, speed_mm_s: float | None = None) -> str:
        return await self._note("lower", height_mm, speed_mm_s)

    async def guard(self, on: bool) -> str:
        return await self._note("guard", on)

    async def gripper(self, width_mm: float | None, force_n: float | None) -> str:
        return await self._note("gripper", width_mm, force_n)

    async def release(self, width_mm: float | None = None) -> str:
        return await self._note("release", width_mm)

    async def clear(self) -> str:
        return await self._note("clear")

    async def calibrate(self, *, force: bool = False) -> Mapping[str, NoContact]:
        await self._note("calibrate", force)
        image = np.full((320, 240, 3), 90, np.uint8)
        return {name: NoContact(image, (2.9, 1.5, 2.4), 30) for name in ("left", "right")}


@asynccontextmanager
async def served(control: Control, path: Path) -> AsyncIterator[Path]:
    """The API on a real socket, for as long as the block lasts."""
    serving = asyncio.create_task(serve(make_app(control), path), name="api")
    while not serving.done():
        try:
            _, writer = await asyncio.open_unix_connection(path)
            break
        except OSError:
            await asyncio.sleep(0.005)
    else:
        await serving
        raise AssertionError("the server ended by itself")
    writer.close()
    await writer.wait_closed()
    try:
        yield path
    finally:
        serving.cancel()
        await asyncio.gather(serving, return_exceptions=True)
