"""The local API on a real Unix socket: requests, errors, and the socket's file."""

from __future__ import annotations

import asyncio
import grp
import json
import os
import socket
import stat
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import cv2
import httpx
import numpy as np
import pytest
from fake_daemon_api import FakeDaemonApi, served
from pydantic import ValidationError

from slipguard.daemon.api.client import Client, DaemonNotRunning
from slipguard.daemon.api.requests import (
    ActivateRequest,
    CalibrateRequest,
    ClearRequest,
    DaemonRequest,
    GraspRequest,
    GuardRequest,
    LiftRequest,
    LowerRequest,
    MoveJawsRequest,
    ReleaseRequest,
    RestoreBackgroundRequest,
)
from slipguard.errors import CommandRefused, ConfigError, DeviceTimeout, SlipguardError
from slipguard.web import serve, sockets
from slipguard.web.app import make_app
from slipguard.web.route_context import RouteContext
from slipguard.web.sockets import bind, bind_tcp


@pytest.fixture
def daemon() -> FakeDaemonApi:
    return FakeDaemonApi()


async def on_socket(daemon: FakeDaemonApi, folder: Path, ask: Callable[[Client], Any]) -> Any:
    """What a client in another thread gets from the served daemon."""

    def ask_and_close(path: Path) -> Any:
        with Client(path) as client:
            return ask(client)

    async with served(daemon, folder / "s") as path:
        return await asyncio.to_thread(ask_and_close, path)


def in_memory(daemon: FakeDaemonApi) -> httpx.AsyncClient:
    """A client of the app without a socket."""
    return httpx.AsyncClient(
        transport=httpx.ASGITransport(make_app(RouteContext(daemon)), raise_app_exceptions=False),
        base_url="http://slipguard",
    )


REQUESTS: list[DaemonRequest] = [
    GraspRequest(),
    GraspRequest(force_n=30),
    LiftRequest(),
    LiftRequest(height_mm=120, speed_mm_s=25.5),
    LowerRequest(height_mm=10),
    GuardRequest(on=True),
    GuardRequest(on=False),
    MoveJawsRequest(width_mm=60, force_n=30),
    ReleaseRequest(confirm=True),
    ReleaseRequest(confirm=True, width_mm=50),
    ActivateRequest(confirm=True),
    ClearRequest(),
    RestoreBackgroundRequest(finger="left", number=3),
    CalibrateRequest(),
    CalibrateRequest(force=True),
]


@pytest.mark.parametrize("request_", REQUESTS, ids=repr)
async def test_every_request_reaches_the_daemon_unchanged(
    request_: DaemonRequest, daemon: FakeDaemonApi, tmp_path: Path
) -> None:
    response = await on_socket(daemon, tmp_path, lambda client: client.submit(request_))
    assert daemon.requests == [request_]
    if isinstance(request_, CalibrateRequest):
        assert response["fingers"]["left"] == {"frames": 30, "noise_bgr": [2.9, 1.5, 2.4], "level_bgr": [90.0] * 3}
    else:
        assert response == {"message": f"{request_.kind}: done"}


async def test_state_and_health(daemon: FakeDaemonApi, tmp_path: Path) -> None:
    assert await on_socket(daemon, tmp_path, Client.state) == daemon.snapshot()
    assert await on_socket(daemon, tmp_path, Client.healthz) == {"status": "ok"}
    daemon.problem = "left: no frames"
    with pytest.raises(SlipguardError, match=r"^left: no frames$"):
        await on_socket(daemon, tmp_path, Client.healthz)


async def test_a_frame_comes_as_a_png_with_its_sensor_number_and_time(daemon: FakeDaemonApi, tmp_path: Path) -> None:
    seen = await on_socket(daemon, tmp_path, lambda client: client.frame("right"))
    assert (seen.serial, seen.sequence, seen.captured_at_s) == ("D20002", 1, 12.25)
    image = cv2.imdecode(np.frombuffer(seen.png, np.uint8), cv2.IMREAD_COLOR)
    assert np.array_equal(image, np.random.default_rng(0).integers(0, 256, (320, 240, 3), np.uint8))
    daemon.failure = CommandRefused("no frame of the right finger: it was unplugged")
    with pytest.raises(CommandRefused, match="unplugged"):
        await on_socket(daemon, tmp_path, lambda client: client.frame("right"))


async def test_the_client_raises_refusals_and_device_errors_with_their_text(
    daemon: FakeDaemonApi, tmp_path: Path
) -> None:
    daemon.failure = CommandRefused("cannot lift while idle")
    with pytest.raises(CommandRefused, match=r"^cannot lift while idle$"):
        await on_socket(daemon, tmp_path, lambda client: client.submit(LiftRequest()))
    daemon.failure = DeviceTimeout("gripper: no answer")
    with pytest.raises(SlipguardError, match=r"^gripper: no answer$"):
        await on_socket(daemon, tmp_path, lambda client: client.submit(GraspRequest()))


BAD = [
    ("POST", "/grasp", "{", 400, "not JSON"),
    ("POST", "/grasp", "\xff\xfe", 400, "not JSON"),
    ("POST", "/grasp", "[1]", 422, "the table"),
    ("POST", "/grasp", '{"force_n": "30"}', 422, "force_n"),
    ("POST", "/grasp", '{"force_n": -1}', 422, "force_n"),
    ("POST", "/grasp", '{"force_n": 1e9}', 422, "force_n"),
    ("POST", "/grasp", '{"force_n": NaN}', 422, "force_n"),
    ("POST", "/grasp", '{"forse_n": 30}', 422, "force_n"),
    ("POST", "/lift", '{"height_mm": 0}', 422, "height_mm"),
    ("POST", "/guard", "{}", 422, "on: missing"),
    ("POST", "/guard", '{"on": 1}', 422, "on"),
    ("POST", "/release", "{}", 422, "confirm: missing"),
    ("POST", "/release", '{"confirm": false}', 422, "confirm"),
    ("POST", "/release", '{"confirm": 1}', 422, "confirm"),
    ("POST", "/clear", '{"really": true}', 422, "really"),
    ("POST", "/grasp", " " * 5000, 413, "4096"),
    ("GET", "/release", "", 405, "POST"),
    ("POST", "/state", "", 405, "GET"),
    ("GET", "/nowhere", "", 404, "no such path"),
]


@pytest.mark.parametrize(("method", "path", "body", "status", "says"), BAD)
async def test_invalid_requests_change_nothing_and_return_one_line(
    method: str, path: str, body: str, status: int, says: str, daemon: FakeDaemonApi
) -> None:
    async with in_memory(daemon) as http:
        response = await http.request(method, path, content=body.encode("latin-1"))
    assert response.status_code == status
    error = response.json()["error"]
    assert says in error
    assert "\n" not in error
    assert daemon.requests == []


async def test_an_internal_error_is_one_line_too(daemon: FakeDaemonApi) -> None:
    daemon.failure = KeyError("secret detail")
    async with in_memory(daemon) as http:
        response = await http.post("/clear")
    assert response.status_code == 500
    assert response.json() == {"error": "/clear failed inside the daemon (KeyError); see the daemon's log"}


@pytest.mark.parametrize(("group", "mode"), [(sockets.SOCKET_GROUP, 0o660), ("no-such-group", 0o600)])
async def test_the_socket_is_for_owner_and_serial_group_and_is_removed_afterwards(
    group: str, mode: int, daemon: FakeDaemonApi, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "run" / "s"
    own = grp.getgrgid(os.getgid())  # in place of dialout, which this user need not be a member of
    groups = {sockets.SOCKET_GROUP: own}
    monkeypatch.setattr(sockets.grp, "getgrnam", lambda name: groups[name])
    monkeypatch.setattr(sockets, "SOCKET_GROUP", group)
    async with served(daemon, path):
        assert (stat.S_IMODE(path.stat().st_mode), path.stat().st_gid) == (mode, own.gr_gid)
    assert not path.exists()


async def test_the_socket_of_a_dead_daemon_is_replaced_that_of_a_live_one_is_not(
    daemon: FakeDaemonApi, tmp_path: Path
) -> None:
    path = tmp_path / "s"
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(str(path))
    async with served(daemon, path):
        with pytest.raises(SlipguardError, match="another daemon is listening at"):
            bind(path)
        assert await asyncio.to_thread(lambda: _state(path)) == daemon.snapshot()


def test_invalid_socket_paths_are_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    with pytest.raises(ConfigError, match="not a socket"):
        bind(tmp_path / "file")
    assert (tmp_path / "file").read_text() == "mine"
    with pytest.raises(ConfigError, match="cannot be created"):
        bind(tmp_path / "file" / "s")
    with pytest.raises(ConfigError, match="107 bytes"):
        bind(tmp_path / ("x" * 120))


async def test_stopping_waits_for_a_short_response_but_not_for_an_idle_client(
    daemon: FakeDaemonApi, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        serve, "SHUTDOWN_TIMEOUT_S", 20
    )  # a busy machine is slow, and the idle client must not be waited for
    daemon.delay_s = 0.3
    async with served(daemon, tmp_path / "s") as path:
        _, idle = await asyncio.open_unix_connection(path)
        pending = asyncio.create_task(asyncio.to_thread(lambda: _clear(path)))
        await daemon.started.wait()
    assert await pending == {"message": "clear: done"}
    idle.close()
    await idle.wait_closed()


async def test_without_a_daemon_the_client_says_how_to_start_one(tmp_path: Path) -> None:
    path = tmp_path / "s"
    with (
        Client(path) as client,
        pytest.raises(DaemonNotRunning, match=r"no daemon is listening at .*/s: start it with"),
    ):
        client.state()


async def test_another_server_on_the_socket_is_detected(tmp_path: Path) -> None:
    async def stranger(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            await reader.readuntil(b"\r\n\r\n")
            writer.write(b"HTTP/1.1 200 OK\r\nContent-Length: 2\r\n\r\nhi")
            await writer.drain()
        except asyncio.IncompleteReadError:
            pass  # the client only tried whether the socket accepts connections
        finally:
            writer.close()
            await writer.wait_closed()

    async with await asyncio.start_unix_server(stranger, tmp_path / "s"):
        with pytest.raises(SlipguardError, match="is not a slipguard daemon"):
            await asyncio.to_thread(lambda: _state(tmp_path / "s"))


async def test_many_clients_at_once(daemon: FakeDaemonApi, tmp_path: Path) -> None:
    async with served(daemon, tmp_path / "s") as path:
        transport = httpx.AsyncHTTPTransport(uds=str(path))
        async with httpx.AsyncClient(transport=transport, base_url="http://slipguard") as http:
            responses = await asyncio.gather(*(http.post("/lift", json={"height_mm": n}) for n in range(1, 51)))
    assert [response.status_code for response in responses] == [200] * 50
    assert sorted(request.height_mm for request in daemon.requests) == [float(n) for n in range(1, 51)]  # type: ignore[attr-defined]
    assert json.loads(responses[0].content) == {"message": "lift: done"}


def _state(path: Path) -> dict[str, Any]:
    with Client(path) as client:
        return client.state()


def _clear(path: Path) -> dict[str, Any]:
    with Client(path) as client:
        return client.submit(ClearRequest())


@pytest.mark.parametrize(
    ("number", "taken"), [("3", True), ("3.0", True), ("3.5", False), ("true", False), ("NaN", False)]
)
def test_an_integer_may_be_written_with_a_decimal_point(number: str, taken: bool) -> None:
    body = '{"finger": "left", "number": %s}' % number  # noqa: UP031
    if taken:
        assert RestoreBackgroundRequest.model_validate_json(body) == RestoreBackgroundRequest(finger="left", number=3)
    else:
        with pytest.raises(ValidationError):
            RestoreBackgroundRequest.model_validate_json(body)


async def test_responses_over_tcp_are_sent_without_delay() -> None:
    """Without TCP_NODELAY, a response on a connection in use takes 40 ms longer."""
    accepted: asyncio.Future[int] = asyncio.get_running_loop().create_future()

    def on_connect(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        connection = writer.get_extra_info("socket")
        accepted.set_result(connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY))
        writer.close()

    with closing(bind_tcp("127.0.0.1", 0)) as listening:
        async with await asyncio.start_server(on_connect, sock=listening):
            _, writer = await asyncio.open_connection(*listening.getsockname())
            assert await accepted == 1
            writer.close()
            await writer.wait_closed()
