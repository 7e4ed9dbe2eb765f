"""The frame format over a socket: the reader recognizes garbage and checks every field."""

from __future__ import annotations

import asyncio
import math
import os
import struct
from collections.abc import AsyncIterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slipguard.devices import DriverContext
from slipguard.errors import DeviceLost, FrameCorrupt
from slipguard_drivers.digit.replay import ReplaySensor
from slipguard_drivers.socket_camera import PIXEL_BYTES_MAX, FrameStreamError, SocketSensor, parse_header
from slipguard_emulators.cell.frame_server import FrameServer, pack_frame

GREETING = b'{"frames": 1, "serial": "T-1", "fps": 60}\n'
GEL_IMAGE = np.random.default_rng(3).integers(0, 256, (320, 240, 3), np.uint8)


def sensor_at(path: Path) -> SocketSensor:
    return SocketSensor(SocketSensor.Settings(path=path), DriverContext("left"))


class Script:
    """A server that says what the test wants and then waits."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / "script.sock"
        self.lines: list[bytes] = []
        self._done = asyncio.Event()

    async def start(self) -> None:
        self._server = await asyncio.start_unix_server(self._serve, self.path)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        for line in self.lines:
            writer.write(line)
        await self._done.wait()
        writer.close()

    async def stop(self) -> None:
        self._done.set()
        self._server.close()
        await asyncio.sleep(0.01)


@pytest.fixture
async def script(tmp_path: Path) -> AsyncIterator[Script]:
    script = Script(tmp_path)
    await script.start()
    yield script
    await script.stop()


def test_the_header_is_28_bytes_in_the_stated_order() -> None:
    packet = pack_frame(GEL_IMAGE, 12.5, 7)
    assert packet[:28] == b"SGF1" + struct.pack("<HHIdQ", 240, 320, 230400, 12.5, 7)
    assert packet[28:] == GEL_IMAGE.tobytes()


@given(st.binary(min_size=28, max_size=28))
def test_any_28_bytes_are_parsed_or_refused(raw: bytes) -> None:
    try:
        header = parse_header(raw)
    except FrameStreamError:
        return
    assert raw[:4] == b"SGF1"
    assert header.pixel_bytes <= PIXEL_BYTES_MAX


@pytest.mark.parametrize(
    "line",
    [
        b"",
        b"hello\n",
        b"[1]\n",
        b"\xff\xfe\n",
        b'{"frames": 1}\n',
        b'{"frames": 2, "serial": "A", "fps": 60}\n',
        b'{"frames": 1, "serial": "../../etc", "fps": 60}\n',
        b'{"frames": 1, "serial": "A", "fps": 1e999}\n',
    ],
)
async def test_a_server_without_greeting_is_refused(script: Script, line: bytes) -> None:
    script.lines = [line + b"\n"]
    with pytest.raises(DeviceLost):
        await sensor_at(script.path).open()


async def test_a_greeting_without_end_times_out(script: Script) -> None:
    script.lines = [b"x" * 2_000_000]
    with pytest.raises(DeviceLost):
        await sensor_at(script.path).open()


async def test_a_frame_is_transmitted_unchanged(script: Script) -> None:
    script.lines = [GREETING, pack_frame(GEL_IMAGE, 5.25, 41)]
    sensor = sensor_at(script.path)
    await sensor.open()
    frame = await sensor.next_frame()
    assert np.array_equal(frame.image, GEL_IMAGE)
    assert (frame.captured_at_s, frame.sequence, sensor.serial, sensor.fps) == (5.25, 41, "T-1", 60.0)
    await sensor.close()


@pytest.mark.parametrize("captured_at_s", [math.nan, math.inf])
async def test_an_invalid_capture_time_is_a_damaged_frame(script: Script, captured_at_s: float) -> None:
    script.lines = [GREETING, pack_frame(GEL_IMAGE, captured_at_s, 1)]
    sensor = sensor_at(script.path)
    await sensor.open()
    with pytest.raises(FrameCorrupt, match="captured at"):
        await sensor.next_frame()
    await sensor.close()


@pytest.mark.parametrize("shape", [(240, 320, 3), (320, 240, 1), (1, 1, 3)])
async def test_an_image_of_another_size_is_a_damaged_frame(script: Script, shape: tuple[int, int, int]) -> None:
    script.lines = [GREETING, pack_frame(np.zeros(shape, np.uint8), 1.0, 1)]
    sensor = sensor_at(script.path)
    await sensor.open()
    with pytest.raises(FrameCorrupt, match="instead of 230400"):
        await sensor.next_frame()
    await sensor.close()


@pytest.mark.parametrize("garbage", [bytes(28), b"SGF1" + b"\xff" * 24])
async def test_a_client_that_lost_its_position_disconnects(script: Script, garbage: bytes) -> None:
    script.lines = [GREETING, garbage]
    sensor = sensor_at(script.path)
    await sensor.open()
    with pytest.raises(DeviceLost, match="broken"):
        await sensor.next_frame()
    await sensor.close()


async def test_a_camera_accepts_one_client(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "0.png"), GEL_IMAGE)
    server = FrameServer(
        tmp_path / "s.sock", ReplaySensor(ReplaySensor.Settings(path=tmp_path), DriverContext("x")), 60.0
    )
    server.plug()
    first, second = sensor_at(server.path), sensor_at(server.path)
    await first.open()
    with pytest.raises(DeviceLost, match="another program"):
        await second.open()
    await first.close()
    await second.open()
    await second.close()
    await server.close()
    assert not (await asyncio.to_thread(os.path.lexists, server.path))


async def test_no_socket_says_what_to_start(tmp_path: Path) -> None:
    with pytest.raises(DeviceLost, match="slipguard emulate cell"):
        await sensor_at(tmp_path / "none.sock").open()
