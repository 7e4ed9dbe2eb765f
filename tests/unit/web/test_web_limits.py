"""Limits for slow, idle and many clients."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import json
from pathlib import Path

import h11
import h11._readers
import httpx
import pytest
from fake_daemon_api import FakeDaemonApi, served_on_tcp
from websockets.asyncio.client import connect
from websockets.exceptions import InvalidStatus

from slipguard.web import commands, connections, middleware, serve
from slipguard.web.access import Access
from slipguard.web.middleware import ApiMiddleware


async def closed_after_s(port: int, *pieces: bytes, pause_s: float = 0.05) -> tuple[float, bytes]:
    """When the server ended a connection on which the pieces came one after the other, and what it said."""
    loop = asyncio.get_running_loop()
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    began_s = loop.time()
    for piece in pieces:
        writer.write(piece)
        await asyncio.sleep(pause_s)
    async with asyncio.timeout(10.0):
        try:
            output = await reader.read()
        except ConnectionError:
            output = b""
    writer.close()
    return loop.time() - began_s, output


async def test_unfinished_requests_time_out(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(connections, "REQUEST_TIMEOUT_S", 0.4)
    monkeypatch.setattr(commands, "BODY_TIMEOUT_S", 0.4)
    monkeypatch.setattr(serve, "KEEP_ALIVE_S", 1)
    async with served_on_tcp(FakeDaemonApi(), tmp_path) as (port, access):
        silent = closed_after_s(port)
        drops = closed_after_s(port, *[b"x"] * 30)
        head = f"GET /access HTTP/1.1\r\nhost: 127.0.0.1:{port}\r\n".encode()
        unfinished = closed_after_s(port, head)
        again = closed_after_s(port, head + b"\r\n", head)
        idle = closed_after_s(port, head + b"\r\n")
        received = f"authorization: Bearer {access._token}\r\ncontent-length: 9\r\n\r\n"
        body = closed_after_s(port, head.replace(b"GET /access", b"POST /clear") + received.encode(), b"{")
        found = await asyncio.gather(silent, drops, unfinished, again, idle, body)
    assert [time_s < 8.0 for time_s, _ in found] == [True] * 6
    assert [output for _, output in found[:3]] == [b"", b"", b""]
    assert found[3][1].count(b"200 OK") == 1
    assert found[4][1].count(b"200 OK") == 1
    assert b"408" in found[5][1]
    assert b"was not received within" in found[5][1]


async def test_a_request_in_progress_is_not_cut_off(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(connections, "REQUEST_TIMEOUT_S", 0.2)
    daemon = FakeDaemonApi()
    daemon.delay_s = 0.6
    async with served_on_tcp(daemon, tmp_path) as (port, access), httpx.AsyncClient(trust_env=False) as http:
        token = {"authorization": f"Bearer {access._token}"}
        response = await http.post(f"http://127.0.0.1:{port}/clear", headers=token)
        assert response.json() == {"message": "clear: done"}


async def test_one_connection_too_many_closes_the_one_idle_longest(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(connections, "CONNECTIONS_MAX", 5)
    async with served_on_tcp(FakeDaemonApi(), tmp_path) as (port, _), httpx.AsyncClient(trust_env=False) as http:
        held = []
        for _ in range(5):
            held.append(await asyncio.open_connection("127.0.0.1", port))
            await asyncio.sleep(0.02)
        assert (await http.get(f"http://127.0.0.1:{port}/access")).status_code == 200
        async with asyncio.timeout(5.0):
            with contextlib.suppress(ConnectionError):
                assert await held[0][0].read() == b""
        for _, one in held[1:]:
            one.write(b"GET /access HTTP/1.1\r\n")
            assert not one.is_closing()
        for _, one in held:
            one.close()
            with contextlib.suppress(ConnectionError):
                await one.wait_closed()


async def test_a_connection_is_refused_if_all_others_are_busy(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(connections, "CONNECTIONS_MAX", 1)
    daemon = FakeDaemonApi()
    daemon.delay_s = 1.5
    async with served_on_tcp(daemon, tmp_path) as (port, access), httpx.AsyncClient(trust_env=False) as http:
        token = {"authorization": f"Bearer {access._token}"}
        pending = asyncio.create_task(http.post(f"http://127.0.0.1:{port}/clear", headers=token))
        await daemon.started.wait()
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        output = await reader.read()
        assert output.startswith(b"HTTP/1.1 503 ")
        assert json.loads(output.partition(b"\r\n\r\n")[2]) == {"error": "too many connections"}
        writer.close()
        await writer.wait_closed()
        assert (await pending).json() == {"message": "clear: done"}


async def test_clients_with_the_token_are_served_among_many_without(tmp_path: Path) -> None:
    async with served_on_tcp(FakeDaemonApi(), tmp_path) as (port, access), contextlib.AsyncExitStack() as stack:
        live = f"ws://127.0.0.1:{port}/live"
        for _ in range(middleware.UNKNOWN_STREAMS_MAX):
            await stack.enter_async_context(connect(live))
        with pytest.raises(InvalidStatus, match="503"):
            await stack.enter_async_context(connect(live))
        token = {"authorization": f"Bearer {access._token}"}
        await stack.enter_async_context(connect(live, additional_headers=token))
        async with httpx.AsyncClient(trust_env=False) as http:
            url = f"http://127.0.0.1:{port}"
            assert (await http.get(f"{url}/state")).status_code == 200
            assert (await http.post(f"{url}/clear", headers=token)).status_code == 200


async def test_clients_without_the_token_are_limited() -> None:
    done = asyncio.Event()

    async def app(scope: object, receive: object, send: object) -> None:
        await done.wait()

    guarded = ApiMiddleware(app, lambda headers: "authorization" in headers)  # type: ignore[arg-type]
    async with httpx.AsyncClient(transport=httpx.ASGITransport(guarded), base_url="http://s") as http:  # type: ignore[arg-type]
        scope = {"type": "http", "headers": []}
        under_way = [
            asyncio.create_task(guarded(scope, None, None))  # type: ignore[arg-type]
            for _ in range(middleware.UNKNOWN_CLIENTS_MAX)
        ]
        await asyncio.sleep(0)
        assert (await http.get("/state")).status_code == 503
        token = [(b"authorization", b"Bearer x")]
        own = asyncio.create_task(guarded(scope | {"headers": token}, None, None))  # type: ignore[arg-type]
        await asyncio.sleep(0.05)
        assert not own.done()
        done.set()
        await asyncio.gather(own, *under_way)


async def test_too_many_requests_get_status_503() -> None:
    full, done = asyncio.Event(), asyncio.Event()

    async def app(scope: object, receive: object, send: object) -> None:
        full.set()
        await done.wait()

    guarded = ApiMiddleware(app, clients_max=1)  # type: ignore[arg-type]
    first = asyncio.create_task(guarded({"type": "http"}, None, None))  # type: ignore[arg-type, dict-item]
    await full.wait()
    async with httpx.AsyncClient(transport=httpx.ASGITransport(guarded), base_url="http://s") as http:  # type: ignore[arg-type]
        response = await http.get("/state")
        assert (response.status_code, set(response.json())) == (503, {"error"})
        assert response.headers["x-frame-options"] == "DENY"
        done.set()
        await first
    output: list[dict[str, object]] = []

    async def send(message: dict[str, object]) -> None:
        output.append(message)

    await ApiMiddleware(app, clients_max=0)({"type": "websocket"}, None, send)  # type: ignore[arg-type, dict-item]
    assert output == [
        {
            "type": "websocket.close",
            "code": 1008,
            "reason": "too many clients: 0 requests are being processed; try again later",
        }
    ]


def hostile_cookies(size: int) -> list[str]:
    """Cookies that a quadratic parser needs seconds for, below and above the limit of the headers."""
    return ['slipguard="' + "\\" * size + '"', 'x="' + "\\n" * (size // 2) + '"', "a=b;" * (size // 4), "=" * size]


@pytest.mark.parametrize("size", [connections.HEADERS_MAX_BYTES - 500, 60_000, 120_000])
async def test_hostile_cookies_do_not_reach_a_parser(
    size: int, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    decoded: list[str] = []
    monkeypatch.setattr("http.cookies._unquote", lambda value: decoded.append(value) or value)
    status = b"HTTP/1.1 200 OK" if size < connections.HEADERS_MAX_BYTES else b"HTTP/1.1 400 Bad Request"
    async with served_on_tcp(FakeDaemonApi(), tmp_path) as (port, _):
        for cookie in hostile_cookies(size):
            reader, writer = await asyncio.open_connection("127.0.0.1", port)
            writer.write(f"GET /access HTTP/1.1\r\nhost: 127.0.0.1:{port}\r\ncookie: {cookie}\r\n\r\n".encode())
            assert (await reader.readline()).strip() == status
            writer.close()
            with contextlib.suppress(ConnectionError):
                await writer.wait_closed()
    assert decoded == []


async def test_headers_are_bounded_before_they_are_parsed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    parsed: list[int] = []
    read = h11._readers.maybe_read_from_IDLE_client

    def measured(buffer: h11._readers.ReceiveBuffer) -> object:
        parsed.append(len(buffer))
        return read(buffer)

    monkeypatch.setitem(h11._readers.READERS, (h11.CLIENT, h11.IDLE), measured)
    async with served_on_tcp(FakeDaemonApi(), tmp_path) as (port, _):
        head = f"GET /access HTTP/1.1\r\nhost: 127.0.0.1:{port}\r\n"
        for more in ("x: " + "y" * 200_000, "x: y\r\n" * 30_000):
            reader, writer = await asyncio.open_connection("127.0.0.1", port)
            writer.write(f"{head}{more}\r\n\r\n".encode())
            assert b" 400 " in await reader.readline()
            writer.close()
            with contextlib.suppress(ConnectionError):
                await writer.wait_closed()
    assert max(parsed) <= connections.HEADERS_MAX_BYTES + connections.PIECE_BYTES


async def test_the_host_is_checked_before_any_credentials(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    inspected: list[str] = []
    monkeypatch.setattr(Access, "_has_cookie", lambda self, headers: bool(inspected.append("cookie")))
    monkeypatch.setattr(Access, "_has_token", lambda self, headers: bool(inspected.append("token")))
    async with served_on_tcp(FakeDaemonApi(), tmp_path) as (port, _), httpx.AsyncClient(trust_env=False) as http:
        url = f"http://127.0.0.1:{port}/access"
        refused = await http.get(url, headers={"host": "evil.example", "cookie": "slipguard=x"})
        assert (refused.status_code, inspected) == (403, [])
        await http.get(url)
        assert inspected


async def test_each_cycle_of_the_event_loop_handles_one_connection() -> None:
    receive_queue, handled, loop = connections.ReceiveQueue(), list[int](), asyncio.get_running_loop()

    def handle(number: int) -> None:
        handled.append(number)
        if number == 1:
            raise ValueError("a broken request")

    errors: list[object] = []
    loop.set_exception_handler(lambda loop, context: errors.append(context["exception"]))
    for number in range(4):
        receive_queue.add(loop, functools.partial(handle, number))
    for number in range(4):
        await asyncio.sleep(0)
        assert handled == list(range(number + 1))
    assert [str(error) for error in errors] == ["a broken request"]
    receive_queue.add(loop, functools.partial(handle, 9))
    await asyncio.sleep(0)
    assert handled[-1] == 9


async def test_a_large_body_of_a_queued_connection_arrives_completely(tmp_path: Path) -> None:
    async with served_on_tcp(FakeDaemonApi(), tmp_path) as (port, access), httpx.AsyncClient(trust_env=False) as http:
        headers = {"authorization": f"Bearer {access._token}"}
        for size, status in ((commands.BODY_MAX_BYTES, 200), (3_000_000, 413)):
            response = await http.post(f"http://127.0.0.1:{port}/clear", headers=headers, content=b"{}".ljust(size))
            assert response.status_code == status
