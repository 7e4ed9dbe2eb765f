"""Limits for slow, idle and many clients."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import json
from collections.abc import AsyncIterator, Callable
from pathlib import Path

import h11
import h11._readers
import httpx
import pytest
from fake_daemon_api import FakeDaemonApi, served_on_tcp
from websockets.asyncio.client import connect
from websockets.exceptions import InvalidStatus

from slipguard.web import acceptor, commands, connections, middleware, serve
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


Connection = tuple[asyncio.StreamReader, asyncio.StreamWriter]


async def ask(one: Connection, port: int, token: str | None = None) -> bytes:
    """Send a request on a connection that stays open; return the response's first line."""
    head = f"GET /access HTTP/1.1\r\nhost: 127.0.0.1:{port}\r\n"
    one[1].write((head + (f"authorization: Bearer {token}\r\n\r\n" if token else "\r\n")).encode())
    status = await one[0].readline()
    size = 0
    while (line := await one[0].readline()).strip():
        if line.startswith(b"content-length:"):
            size = int(line.partition(b":")[2])
    await one[0].readexactly(size)
    return status.strip()


async def is_closed(one: Connection) -> bool:
    async with asyncio.timeout(5.0):
        try:
            return await one[0].read(1) == b""
        except ConnectionError:
            return True


@contextlib.asynccontextmanager
async def opened(port: int, count: int) -> AsyncIterator[list[Connection]]:
    held = [await asyncio.open_connection("127.0.0.1", port) for _ in range(count)]
    try:
        yield held
    finally:
        for _, writer in held:
            writer.close()
            with contextlib.suppress(ConnectionError):
                await writer.wait_closed()


OK = b"HTTP/1.1 200 OK"
UNAVAILABLE = b"HTTP/1.1 503 Service Unavailable"


async def test_one_silent_connection_too_many_closes_the_oldest(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(acceptor, "WAITING_MAX", 5)
    async with served_on_tcp(FakeDaemonApi(), tmp_path) as (port, _), opened(port, 6) as held:
        assert await is_closed(held[0])
        assert [await ask(one, port) for one in held[1:]] == [OK] * 5


async def test_a_connection_with_the_token_is_never_closed_for_another_one(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(connections, "UNKNOWN_MAX", 3)
    async with served_on_tcp(FakeDaemonApi(), tmp_path) as (port, access), opened(port, 6) as held:
        assert await ask(held[0], port, access._token) == OK
        for one in held[1:]:
            assert await ask(one, port) == OK
        assert await is_closed(held[1])
        assert await is_closed(held[2])
        assert await ask(held[0], port, access._token) == OK, "idle for longest, and open"
        assert [await ask(one, port) for one in held[3:]] == [OK] * 3


async def test_a_request_that_waits_in_the_queue_is_not_idle(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(connections, "UNKNOWN_MAX", 2)
    handle, held_back = connections.BoundedHttpProtocol._handle_queued, list[Callable[[], None]]()

    def hold_back(protocol: connections.BoundedHttpProtocol, data: bytes) -> None:
        held_back.append(functools.partial(handle, protocol, data))

    monkeypatch.setattr(connections.BoundedHttpProtocol, "_handle_queued", hold_back)
    async with served_on_tcp(FakeDaemonApi(), tmp_path) as (port, _), opened(port, 3) as held:
        assert await ask(held[0], port) == OK
        assert await ask(held[1], port) == OK
        again = asyncio.create_task(ask(held[0], port))
        while not held_back:  # noqa: ASYNC110 - another task
            await asyncio.sleep(0.01)
        assert await ask(held[2], port) == OK
        assert await is_closed(held[1]), "not the one that is older, but has a request in the queue"
        held_back[0]()
        assert await again == OK


async def test_a_request_with_the_token_waits_for_no_other(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(connections.ReceiveQueue, "_handle_next", lambda queue, loop: None)
    async with served_on_tcp(FakeDaemonApi(), tmp_path) as (port, access), opened(port, 2) as held:
        waiting = asyncio.create_task(ask(held[0], port))
        assert await ask(held[1], port, access._token) == OK
        assert not waiting.done()
        waiting.cancel()


async def test_requests_of_unknown_clients_beyond_the_queue_are_refused(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(acceptor, "QUEUED_MAX", 1)
    monkeypatch.setattr(connections.ReceiveQueue, "_handle_next", lambda queue, loop: None)
    async with served_on_tcp(FakeDaemonApi(), tmp_path) as (port, _), opened(port, 2) as held:
        waiting = asyncio.create_task(ask(held[0], port))
        await asyncio.sleep(0.1)
        assert await ask(held[1], port) == UNAVAILABLE
        waiting.cancel()


@pytest.mark.parametrize("line_end", ["\r\n", "\n"])
async def test_a_request_in_pieces_is_recognized_by_its_token(
    line_end: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(connections.ReceiveQueue, "_handle_next", lambda queue, loop: None)
    async with served_on_tcp(FakeDaemonApi(), tmp_path) as (port, access), opened(port, 1) as ((reader, writer),):
        lines = (
            *("GET /access HTTP/1.1", f"Host: 127.0.0.1:{port}", f"AUTHORIZATION: bearer {access._token}"),
            *("connection: close", "", ""),
        )
        for piece in line_end.join(lines):
            writer.write(piece.encode())
            await asyncio.sleep(0.0)
        assert (await reader.read()).startswith(OK)


async def test_a_response_to_an_unknown_client_times_out(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """One that reads nothing would keep its place."""
    monkeypatch.setattr(connections, "REQUEST_TIMEOUT_S", 0.3)
    daemon, answer = FakeDaemonApi(), asyncio.Event()

    async def late(finger: str, after: int | None = None) -> None:
        await answer.wait()

    monkeypatch.setattr(daemon, "frame", late)
    async with served_on_tcp(daemon, tmp_path) as (port, _), opened(port, 1) as held:
        held[0][1].write(f"GET /frame/left HTTP/1.1\r\nhost: 127.0.0.1:{port}\r\n\r\n".encode())
        assert await is_closed(held[0])
        answer.set()


async def test_silent_connections_time_out(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(connections, "REQUEST_TIMEOUT_S", 0.2)
    async with served_on_tcp(FakeDaemonApi(), tmp_path) as (port, _), opened(port, 2) as held:
        held[1][1].write(b"GET /access HTTP/1.1\r\n")
        assert [await is_closed(one) for one in held] == [True, True]


@pytest.mark.parametrize("limit", ["KNOWN_MAX", "UNKNOWN_MAX"])
async def test_a_connection_is_refused_if_all_others_are_busy(
    limit: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(connections, limit, 1)
    monkeypatch.setattr(connections.BoundedHttpProtocol, "_responding", True)
    async with served_on_tcp(FakeDaemonApi(), tmp_path) as (port, access), opened(port, 3) as held:
        token = access._token if limit == "KNOWN_MAX" else None
        assert await ask(held[0], port, token) == OK
        head = f"GET /access HTTP/1.1\r\nhost: 127.0.0.1:{port}\r\nauthorization: Bearer {token}\r\n\r\n"
        held[1][1].write(head.encode())
        output = await held[1][0].read()
        assert output.startswith(UNAVAILABLE)
        assert json.loads(output.partition(b"\r\n\r\n")[2]) == {"error": "too many connections"}
        assert await ask(held[2], port, None if token else access._token) == OK, "the others are not concerned"
        assert await ask(held[0], port, token) == OK


async def test_pipelined_requests_of_unknown_clients_are_answered_once(tmp_path: Path) -> None:
    async with served_on_tcp(FakeDaemonApi(), tmp_path) as (port, access), opened(port, 2) as held:
        head = f"GET /access HTTP/1.1\r\nhost: 127.0.0.1:{port}\r\n"
        held[0][1].write(f"{head}\r\n".encode() * 3)
        assert (await held[0][0].read()).count(OK) == 1
        held[1][1].write(f"{head}authorization: Bearer {access._token}\r\n\r\n".encode() * 3)
        found = b""
        async with asyncio.timeout(10.0):
            while found.count(OK) < 3:
                found += await held[1][0].read(4096)


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


async def test_queued_requests_take_turns_and_pause_for_as_long_as_they_took() -> None:
    receive_queue, loop = connections.ReceiveQueue(), asyncio.get_running_loop()
    began_s, ended_s = list[float](), list[float]()

    def handle(number: int) -> None:
        began_s.append(loop.time())
        while loop.time() < began_s[-1] + 0.02:
            pass
        ended_s.append(loop.time())
        if number == 1:
            raise ValueError("a broken request")

    errors: list[object] = []
    loop.set_exception_handler(lambda loop, context: errors.append(context["exception"]))
    for number in range(4):
        receive_queue.add(loop, functools.partial(handle, number))
    while len(ended_s) < 4:  # noqa: ASYNC110 - each request must find the loop free
        await asyncio.sleep(0.01)
    for before_s, next_s in zip(ended_s, began_s[1:], strict=False):
        assert next_s - before_s >= 0.02
    assert [str(error) for error in errors] == ["a broken request"]
    await asyncio.sleep(0.1)
    receive_queue.add(loop, functools.partial(handle, 9))
    await asyncio.sleep(0)
    assert len(began_s) == 5, "at once again"


async def test_a_large_body_of_a_queued_connection_arrives_completely(tmp_path: Path) -> None:
    async with served_on_tcp(FakeDaemonApi(), tmp_path) as (port, access), httpx.AsyncClient(trust_env=False) as http:
        headers = {"authorization": f"Bearer {access._token}"}
        for size, status in ((commands.BODY_MAX_BYTES, 200), (3_000_000, 413)):
            response = await http.post(f"http://127.0.0.1:{port}/clear", headers=headers, content=b"{}".ljust(size))
            assert response.status_code == status
