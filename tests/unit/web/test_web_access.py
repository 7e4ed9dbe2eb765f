"""Access control on a real port, with requests that another page in the operator's browser could send."""

from __future__ import annotations

import asyncio
import os
import stat
from pathlib import Path
from typing import Any

import httpx
import pytest
from fake_daemon_api import TOKEN, FakeDaemonApi, served_on_tcp
from websockets.asyncio.client import connect
from websockets.exceptions import InvalidStatus

from slipguard.daemon.api.requests import ClearRequest
from slipguard.errors import ConfigError
from slipguard.web.access import LINK_VALID_S, LINKS_MAX, Access
from slipguard.web.sockets import token_file

BEARER = {"authorization": f"Bearer {TOKEN}"}


@pytest.fixture
def daemon() -> FakeDaemonApi:
    return FakeDaemonApi()


async def ask(port: int, method: str, path: str, headers: dict[str, str] | None = None, **more: Any) -> httpx.Response:
    async with httpx.AsyncClient(base_url=f"http://127.0.0.1:{port}", trust_env=False) as http:
        return await http.request(method, path, headers=headers, **more)


REFUSED = [
    ({}, 401),
    ({"authorization": "Bearer " + "0" * 64}, 401),
    ({"authorization": TOKEN}, 401),
    ({"authorization": "Bearer ü"}, 401),
    ({"cookie": "slipguard=" + "0" * 64}, 401),
    ({"cookie": f"slipguard={TOKEN}"}, 401),
    (BEARER | {"origin": "http://evil.example"}, 403),
    (BEARER | {"origin": "null"}, 403),
    (BEARER | {"origin": "http://127.0.0.1:1"}, 403),
    (BEARER | {"origin": "https://127.0.0.1:{port}"}, 403),
    (BEARER | {"host": "evil.example:{port}"}, 403),
    (BEARER | {"host": "evil.example"}, 403),
    (BEARER | {"host": "127.0.0.1"}, 403),
    (BEARER | {"host": "127.0.0.1:1"}, 403),
    (BEARER | {"host": "127.0.0.1.evil.example:{port}"}, 403),
    (BEARER | {"host": "evil.example:{port}", "origin": "http://evil.example:{port}"}, 403),
    (BEARER | {"sec-fetch-site": "cross-site"}, 403),
    (BEARER | {"sec-fetch-site": "same-site"}, 403),
    (BEARER | {"sec-fetch-site": "cross-site", "sec-fetch-mode": "navigate", "sec-fetch-dest": "document"}, 403),
]


async def test_commands_without_valid_credentials_change_nothing(daemon: FakeDaemonApi, tmp_path: Path) -> None:
    commands = [("/release", {"confirm": True}), ("/page-link", None)]
    async with served_on_tcp(daemon, tmp_path) as (port, _):
        for headers, status in REFUSED:
            received = {name: value.format(port=port).encode() for name, value in headers.items()}
            for path, body in commands:
                response = await ask(port, "POST", path, received, json=body)  # type: ignore[arg-type]
                assert response.status_code == status, (headers, response.text)
                assert set(response.json()) == {"error"}
                assert "\n" not in response.json()["error"]
                assert not any(name.startswith("access-control") for name in response.headers)
    assert daemon.requests == []


async def test_commands_with_valid_credentials_are_executed(daemon: FakeDaemonApi, tmp_path: Path) -> None:
    async with served_on_tcp(daemon, tmp_path) as (port, _):
        for host in (f"127.0.0.1:{port}", f"localhost:{port}"):
            for more in ({}, {"origin": f"http://{host}"}, {"sec-fetch-site": "same-origin"}):
                response = await ask(port, "POST", "/release", BEARER | {"host": host} | more, json={"confirm": True})
                assert response.json() == {"message": "release: done"}
    assert len(daemon.requests) == 6


READS = ("/state", "/healthz", "/access", "/image/left", "/frame/left", "/metrics", "/openapi.json", "/")


@pytest.mark.parametrize("path", READS)
async def test_reading_needs_no_token_but_the_right_host_name(path: str, daemon: FakeDaemonApi, tmp_path: Path) -> None:
    async with served_on_tcp(daemon, tmp_path) as (port, _):
        assert (await ask(port, "GET", path)).status_code == 200
        for headers in (
            {"host": f"evil.example:{port}"},
            {"origin": "http://evil.example"},
            {"sec-fetch-site": "cross-site", "sec-fetch-mode": "no-cors", "sec-fetch-dest": "image"},
            {"sec-fetch-site": "cross-site", "sec-fetch-mode": "navigate", "sec-fetch-dest": "iframe"},
        ):
            assert (await ask(port, "GET", path, headers)).status_code == 403, headers


async def test_other_pages_may_not_frame_or_embed_the_page(daemon: FakeDaemonApi, tmp_path: Path) -> None:
    async with served_on_tcp(daemon, tmp_path) as (port, _):
        for path in ("/", "/image/left", "/nowhere"):
            received = (await ask(port, "GET", path)).headers
            assert "frame-ancestors 'none'" in received["content-security-policy"]
            assert received["x-frame-options"] == "DENY"
            assert received["cross-origin-resource-policy"] == "same-origin"
            assert received["x-content-type-options"] == "nosniff"


async def test_a_link_gives_control_once(daemon: FakeDaemonApi, tmp_path: Path) -> None:
    async with served_on_tcp(daemon, tmp_path) as (port, access):
        url = (await ask(port, "POST", "/page-link", BEARER)).json()["url"]
        async with httpx.AsyncClient(trust_env=False) as browser:
            assert (await browser.get(f"http://127.0.0.1:{port}/access")).json() == {"control": False}
            response = await browser.get(url)
            assert (response.status_code, response.headers["location"]) == (303, f"/#session={access.session_key}")
            session = {"x-slipguard-session": access.session_key}
            for word in ("HttpOnly", "SameSite=strict", "Path=/"):
                assert word in response.headers["set-cookie"]
            assert TOKEN not in response.headers["set-cookie"]
            assert (await browser.get(f"http://127.0.0.1:{port}/access")).json() == {"control": False}
            stolen = await browser.post(f"http://127.0.0.1:{port}/clear")
            assert stolen.status_code == 401, "a program at another port of this machine is sent the cookie too"
            received = await browser.get(f"http://127.0.0.1:{port}/access", headers=session)
            assert received.json() == {"control": True}
            origin = {"origin": f"http://127.0.0.1:{port}"}
            done = await browser.post(f"http://127.0.0.1:{port}/clear", headers=origin | session)
            assert done.json() == {"message": "clear: done"}
            foreign = await browser.post(
                f"http://127.0.0.1:{port}/clear", headers={"origin": "http://127.0.0.1:1"} | session
            )
            assert foreign.status_code == 403, "another port of this machine is not our page"
            browser.cookies.clear()
            assert (await browser.post(f"http://127.0.0.1:{port}/clear", headers=session)).status_code == 401
        again = await ask(port, "GET", url.partition(str(port))[2])
        assert again.status_code == 401
        assert "set-cookie" not in again.headers
        assert "slipguard ctl page" in again.json()["error"]
        shown = await ask(port, "GET", url.partition(str(port))[2], {"accept": "text/html,*/*;q=0.8"})
        assert (shown.status_code, shown.headers["content-type"]) == (401, "text/html; charset=utf-8")
        assert "set-cookie" not in shown.headers
        assert "slipguard ctl page" in shown.text
    assert daemon.requests == [ClearRequest()]


def test_links_expire() -> None:
    now_s = [0.0]
    access = Access(TOKEN, ("127.0.0.1", 8470), lambda: now_s[0])
    codes = [access.make_link().partition("token=")[2] for _ in range(LINKS_MAX + 1)]
    assert access.redeem(codes[0]) is None, "the oldest of too many"
    assert access.redeem(codes[1]) is not None
    assert access.redeem(codes[1]) is None
    now_s[0] = LINK_VALID_S
    assert access.redeem(codes[2]) is None
    assert access.redeem("") is None


def test_links_contain_a_reachable_address() -> None:
    assert Access(TOKEN, ("127.0.0.1", 8470)).make_link().startswith("http://127.0.0.1:8470/login?token=")
    assert Access(TOKEN, ("::1", 8470)).make_link().startswith("http://[::1]:8470/login?token=")
    assert Access(TOKEN, ("0.0.0.0", 8470)).make_link().startswith(f"http://{os.uname().nodename}:8470/login?token=")


HOSTS = [
    ("127.0.0.1", "127.0.0.1:8470", True),
    ("127.0.0.1", "LOCALHOST:8470", True),
    ("::1", "[::1]:8470", True),
    ("192.0.2.7", "192.0.2.7:8470", True),
    ("192.0.2.7", "localhost:8470", False),
    ("192.0.2.7", "evil.example:8470", False),
    ("0.0.0.0", "192.0.2.7:8470", True),
    ("0.0.0.0", "localhost:8470", True),
    ("0.0.0.0", "evil.example:8470", False),
    ("127.0.0.1", "", False),
    ("127.0.0.1", ":8470", False),
    ("127.0.0.1", "127.0.0.1:8470:8470", False),
    ("127.0.0.1", "evil@127.0.0.1:8470", False),
]


@pytest.mark.parametrize(("listening", "requested", "ours"), HOSTS)
def test_accepted_host_names(listening: str, requested: str, ours: bool) -> None:
    from starlette.datastructures import Headers

    access = Access(TOKEN, (listening, 8470))
    objection = access.find_objection({"type": "http", "method": "GET"}, Headers({"host": requested}))
    assert (objection is None) is ours, objection


async def test_two_host_headers_are_refused(daemon: FakeDaemonApi, tmp_path: Path) -> None:
    async with served_on_tcp(daemon, tmp_path) as (port, _):
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        own = f"host: 127.0.0.1:{port}\r\n"
        writer.write(f"GET /state HTTP/1.1\r\n{own}host: evil\r\nconnection: close\r\n\r\n".encode())
        assert b" 400 " in (await reader.readline()) or b" 403 " in (await reader.readline())
        writer.close()
        await writer.wait_closed()


async def test_another_page_gets_no_live_stream(daemon: FakeDaemonApi, tmp_path: Path) -> None:
    async with served_on_tcp(daemon, tmp_path) as (port, _):
        url = f"ws://127.0.0.1:{port}/live"
        for foreign in ("http://evil.example", "null", "http://127.0.0.1:1"):
            with pytest.raises(InvalidStatus, match="403"):
                await connect(url, origin=foreign)  # type: ignore[arg-type]
        with pytest.raises(InvalidStatus, match="403"):
            await connect(f"ws://evil.example:{port}/live", host="127.0.0.1", port=port)
        async with connect(url, origin=f"http://127.0.0.1:{port}") as socket:  # type: ignore[arg-type]
            assert '"history"' in await socket.recv(decode=True)
        async with connect(url) as socket:
            assert '"history"' in await socket.recv(decode=True)


def test_the_token_file_is_private_new_each_time_and_removed_afterwards(tmp_path: Path) -> None:
    path = tmp_path / "run" / "token"
    with token_file(path) as first:
        assert len(first) == 64
        assert path.read_text() == f"{first}\n"
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert not path.exists()
    path.write_text("another user's, and readable by all")
    path.chmod(0o644)
    with token_file(path) as second:
        assert second != first
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
        path.write_text("a successor's")
    assert path.read_text() == "a successor's"
    assert list(path.parent.iterdir()) == [path]


def test_a_token_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="token cannot be written"), token_file(tmp_path / "file" / "token"):
        pass
