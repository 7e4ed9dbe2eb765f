"""The client of the local API that the ROS 2 and LeRobot packages use, which needs nothing of slipguard."""

from __future__ import annotations

import asyncio
import json
import socket
import struct
import threading
from contextlib import closing
from pathlib import Path

import pytest
from fake_daemon_api import FakeDaemonApi, served

from drivers.slipguard_client import slipguard_client
from drivers.slipguard_client.slipguard_client import (
    DaemonUnreachable,
    LocalApi,
    RequestRefused,
    StreamThread,
    parse_frame,
)
from slipguard.daemon.api.requests import GuardRequest, LiftRequest, ReleaseRequest
from slipguard.errors import CommandRefused

pause = threading.Event().wait


async def test_requests_reach_the_daemon_and_its_reasons_come_back(tmp_path: Path) -> None:
    daemon = FakeDaemonApi()
    async with served(daemon, tmp_path / "s") as path:
        api = LocalApi(str(path))
        assert (await asyncio.to_thread(api.state))["phase"] == "holding"
        assert await asyncio.to_thread(api.submit, "lift", {"height_mm": None}) == "lift: done"
        await asyncio.to_thread(api.submit, "guard", {"on": False})
        await asyncio.to_thread(api.submit, "release", {"confirm": True})
        with pytest.raises(RequestRefused, match="must be true"):
            await asyncio.to_thread(api.submit, "release", {"confirm": False})
        daemon.failure = CommandRefused("cannot lift: nothing is held")
        with pytest.raises(RequestRefused, match="cannot lift: nothing is held"):
            await asyncio.to_thread(api.submit, "lift", {})
    assert daemon.requests[:3] == [LiftRequest(), GuardRequest(on=False), ReleaseRequest(confirm=True)]


async def test_both_streams_deliver_and_return_after_the_daemon_did(tmp_path: Path) -> None:
    path = tmp_path / "s"
    received: dict[str, list[bytes]] = {"/live": [], "/frames/left": []}
    lost: list[str] = []
    streams = [
        StreamThread(LocalApi(str(path)), name, messages.append, lost.append)  # type: ignore[arg-type]
        for name, messages in received.items()
    ]

    def until_all_received() -> None:
        while not all(len(messages) > 3 for messages in received.values()):
            pause(0.01)

    def until_lost() -> None:
        while not any("start it with `slipguard run`" in why for why in lost):
            pause(0.01)

    try:
        async with asyncio.timeout(20.0):
            await asyncio.to_thread(until_lost)
        for _ in range(2):  # the daemon stops and starts again
            for messages in received.values():
                messages.clear()
            async with served(FakeDaemonApi(), path), asyncio.timeout(20.0):
                await asyncio.to_thread(until_all_received)
    finally:
        await asyncio.to_thread(lambda: [stream.stop() for stream in streams])
    assert json.loads(received["/live"][0])["type"] == "history"
    image = parse_frame(bytearray(received["/frames/left"][0]))
    assert (image.width_px, image.height_px, len(image.pixels)) == (240, 320, 230400)
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("slipguard /")]


async def test_without_a_daemon_the_error_names_the_socket(tmp_path: Path) -> None:
    api = LocalApi(str(tmp_path / "none.sock"))
    with pytest.raises(DaemonUnreachable, match=r"no slipguard daemon at .*none\.sock .*slipguard run"):
        api.state()
    async with served(FakeDaemonApi(), tmp_path / "s") as path:
        with pytest.raises(DaemonUnreachable, match="404"):
            await asyncio.to_thread(LocalApi(str(path)).open_stream, "/frames/middle")


def test_a_damaged_frame_is_refused() -> None:
    header = struct.pack("<4sHHIdQ", b"SGF1", 240, 320, 230400, 1.5, 7)
    image = parse_frame(bytearray(header + bytes(230400)))
    assert (image.sequence, image.captured_at_s) == (7, 1.5)
    for damaged in (header, header + bytes(230399), b"XXXX" + header[4:] + bytes(230400), b"{}"):
        with pytest.raises(ValueError, match="is not a frame"):
            parse_frame(bytearray(damaged))


@pytest.fixture
def sockets(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, Path]:
    """Paths of the user's and of the system's socket; the user's daemon was killed, so its file exists."""
    own, system = tmp_path / "slipguard" / "slipguard.sock", tmp_path / "slipguard.sock"
    own.parent.mkdir()
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    monkeypatch.setattr(slipguard_client, "SYSTEM_SOCKET", str(system))
    with closing(socket.socket(socket.AF_UNIX)) as killed:
        killed.bind(str(own))
    return own, system


def listening(path: Path) -> socket.socket:
    path.unlink(missing_ok=True)
    made = socket.socket(socket.AF_UNIX)
    made.bind(str(path))
    made.listen()
    return made


def socket_used(api: LocalApi) -> str:
    """Return the socket of a request that gets no response."""
    with pytest.raises(DaemonUnreachable):
        api.state(0.05)
    return api.socket_path


def test_the_first_daemon_that_responds_is_used_from_then_on(sockets: tuple[Path, Path]) -> None:
    own, system = sockets
    with pytest.raises(DaemonUnreachable, match=f"no slipguard daemon at {system} .*slipguard run"):
        LocalApi().state()
    with closing(listening(system)):
        api = LocalApi()
        assert socket_used(api) == str(system)
        with closing(listening(own)):
            assert socket_used(api) == str(system), "no change of the daemon"
            api = LocalApi()
            assert socket_used(api) == str(own)
            assert socket_used(LocalApi(str(system))) == str(system), "a given socket is the only one"
        with pytest.raises(DaemonUnreachable, match=str(own)):
            api.state()
