"""The stream of frames: every frame once, the newest first for a slow client, and no request without a client."""

from __future__ import annotations

import asyncio
import contextlib
import json
import struct
from pathlib import Path

import numpy as np
import pytest
from fake_daemon_api import FakeDaemonApi, served_on_tcp
from starlette.websockets import WebSocketDisconnect
from websockets.asyncio.client import connect
from websockets.exceptions import InvalidStatus

from slipguard.daemon.api.daemon_api import FingerFrame
from slipguard.daemon.loop.virtual_time import run_virtual
from slipguard.devices import Frame
from slipguard.errors import CommandRefused
from slipguard.web.frame_broadcast import CLIENTS_MAX, FrameBroadcast

PERIOD_S = 1 / 60


class Camera:
    """60 frames per second on the loop's clock; `gone` while there is no sensor."""

    def __init__(self) -> None:
        self.requests = 0
        self.gone = False

    async def fetch(self, after: int | None) -> FingerFrame:
        self.requests += 1
        loop = asyncio.get_running_loop()
        if self.gone:
            raise CommandRefused("no frame of the left finger")
        number = int(loop.time() / PERIOD_S + 1e-6)
        if number == after:
            number += 1
            await asyncio.sleep(number * PERIOD_S - loop.time())
        return FingerFrame("SIM-L", Frame(np.zeros((320, 240, 3), np.uint8), number * PERIOD_S, number))


class Viewer:
    """A client that reads each message for `reads_for_s`."""

    def __init__(self, reads_for_s: float = 0.0) -> None:
        self.sequences: list[int] = []
        self.ages_s: list[float] = []
        self.reads_for_s = reads_for_s
        self.gone = asyncio.Event()

    async def accept(self) -> None: ...

    async def receive(self) -> dict[str, str]:
        await self.gone.wait()
        return {"type": "websocket.disconnect"}

    async def send_bytes(self, message: bytes) -> None:
        if self.gone.is_set():
            raise WebSocketDisconnect(1006)
        _, _, _, size, captured_at_s, sequence = struct.unpack("<4sHHIdQ", message[:28])
        assert len(message) == 28 + size
        self.ages_s.append(asyncio.get_running_loop().time() - captured_at_s)
        self.sequences.append(sequence)
        await asyncio.sleep(self.reads_for_s)


def watch(camera: Camera, *viewers: Viewer, for_s: float = 2.0) -> None:
    async def scene() -> None:
        broadcast = FrameBroadcast(camera.fetch)
        serving = [asyncio.create_task(broadcast.serve(one)) for one in viewers]  # type: ignore[arg-type]
        await asyncio.sleep(for_s)
        for one in viewers:
            one.gone.set()
        await asyncio.gather(*serving)
        before = camera.requests
        await asyncio.sleep(1.0)
        assert camera.requests == before, "without clients, nothing is requested"

    run_virtual(scene())


def test_each_client_receives_each_frame_once_and_the_daemon_is_asked_once() -> None:
    camera, viewers = Camera(), [Viewer() for _ in range(3)]
    watch(camera, *viewers)
    for one in viewers:
        assert one.sequences == list(range(one.sequences[0], one.sequences[0] + len(one.sequences)))
        assert 119 <= len(one.sequences) <= 121
        assert max(one.ages_s) < 0.001
    assert camera.requests <= 122


def test_a_slow_client_misses_frames_and_delays_no_other() -> None:
    camera, slow, quick = Camera(), Viewer(reads_for_s=0.25), Viewer()
    watch(camera, slow, quick)
    assert len(quick.sequences) >= 119
    assert len(slow.sequences) <= 9
    assert max(slow.ages_s) <= PERIOD_S + 1e-6, "the newest frame, not the one after the last sent"


def test_the_stream_continues_when_the_sensor_is_back() -> None:
    camera, viewer = Camera(), Viewer()

    async def scene() -> None:
        broadcast = FrameBroadcast(camera.fetch)
        serving = asyncio.create_task(broadcast.serve(viewer))  # type: ignore[arg-type]
        await asyncio.sleep(0.5)
        camera.gone = True
        await asyncio.sleep(1.0)
        before = len(viewer.sequences)
        assert camera.requests < 50, "a pause after each failure"
        camera.gone = False
        await asyncio.sleep(0.5)
        assert len(viewer.sequences) - before >= 23
        viewer.gone.set()
        await serving

    run_virtual(scene())


async def test_over_a_real_socket(tmp_path: Path) -> None:
    daemon = FakeDaemonApi()
    async with served_on_tcp(daemon, tmp_path) as (port, _):
        url = f"ws://127.0.0.1:{port}/frames"
        async with connect(f"{url}/right") as socket:
            first, second = await socket.recv(), await socket.recv()
            assert isinstance(first, bytes)
            assert struct.unpack("<4sHHId", first[:20]) == (b"SGF1", 240, 320, 240 * 320 * 3, 12.25)
            assert len(first) == 28 + 240 * 320 * 3
            assert first[28:] != second[28:]
        async with contextlib.AsyncExitStack() as stack:
            for _ in range(CLIENTS_MAX):
                await stack.enter_async_context(connect(f"{url}/left", close_timeout=0.1))
            for finger, status, reason in (("middle", 404, "no finger 'middle'"), ("left", 503, "at most 8 clients")):
                with pytest.raises(InvalidStatus) as refused:
                    await connect(f"{url}/{finger}")
                assert refused.value.response.status_code == status
                assert reason in json.loads(refused.value.response.body)["error"]
