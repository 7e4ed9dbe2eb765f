"""Looking up a host name never blocks a shared thread; meanwhile the last known address is used."""

from __future__ import annotations

import asyncio
import socket
import threading
from collections.abc import Iterator
from typing import Any

import pytest

from slipguard.errors import DeviceLost
from slipguard.host_lookup import HostLookup
from slipguard_drivers.ur5 import rtde

Address = tuple[socket.AddressFamily, int, int, str, tuple[Any, ...]]


class NameServer:
    """Stands in for `socket.getaddrinfo`; while `dead`, a lookup does not come back."""

    def __init__(self) -> None:
        self.alive = threading.Event()
        self.asked = 0

    def __call__(self, host: str, *details: Any, **options: Any) -> list[Address]:
        self.asked += 1
        assert self.alive.wait(30.0)
        if host == "unknown":
            raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")
        return [
            (socket.AF_INET6, 1, 6, "", ("fe80::1", 0, 0, 0)),
            (socket.AF_INET, 1, 6, "", ("192.0.2.10", 0)),
        ]


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[NameServer]:
    server = NameServer()
    monkeypatch.setattr(socket, "getaddrinfo", server)
    yield server
    server.alive.set()


def lookups() -> int:
    return sum(thread.name.startswith("lookup of") for thread in threading.enumerate())


async def test_a_dead_name_server_takes_one_thread_of_its_own(
    server: NameServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rtde, "CONNECT_TIMEOUT_S", 0.02)
    monkeypatch.setattr(rtde, "resolve_host", HostLookup().resolve)
    for _ in range(40):
        with pytest.raises(DeviceLost, match=r"no answer from robot\.example:30004"):
            await rtde.connect_tcp("arm", "robot.example", 30004, "RTDE")
    assert (server.asked, lookups()) == (1, 1)
    async with asyncio.timeout(10.0):
        assert await asyncio.to_thread(lambda: "free") == "free"


async def test_the_last_known_address_is_used_while_the_name_server_is_dead(
    server: NameServer,
) -> None:
    lookup = HostLookup()
    server.alive.set()
    assert await lookup.resolve("robot.example") == "192.0.2.10"
    server.alive.clear()
    known = lookup.resolve("robot.example")
    with pytest.raises(StopIteration) as returned:
        known.send(None)
    assert returned.value.value == "192.0.2.10", "without waiting: a stop has 0.3 s"
    assert server.asked == 2, "the address is looked up again for the next time"


def test_an_answer_after_the_end_of_the_loop_is_dropped(server: NameServer) -> None:
    lookup = HostLookup()

    async def give_up() -> None:
        with pytest.raises(TimeoutError):
            await asyncio.wait_for(lookup.resolve("robot.example"), 0.02)

    asyncio.run(give_up())
    server.alive.set()
    for thread in threading.enumerate():
        if thread.name.startswith("lookup of"):
            thread.join(10.0)
    assert lookups() == 0
