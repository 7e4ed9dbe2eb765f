"""A stop request is served at once, however many other requests are being processed."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from pathlib import Path

import httpx
from fake_daemon_api import FakeDaemonApi
from hosted_api import hosted

from slipguard.daemon.api.requests import DaemonRequest
from slipguard.web.middleware import CLIENTS_MAX


class BusyDaemon(FakeDaemonApi):
    """Answers other requests than `stop` only when `free` is set. full: as many as the web process takes have come."""

    def __init__(self) -> None:
        super().__init__()
        self.full, self.free = asyncio.Event(), asyncio.Event()

    async def submit(self, request: DaemonRequest, deadline_s: float | None = None) -> Mapping[str, object]:
        self.requests.append(request)
        if len(self.requests) == CLIENTS_MAX:
            self.full.set()
        if request.kind != "stop":
            await self.free.wait()
        return {"message": f"{request.kind}: done"}


async def test_a_stop_is_served_while_all_places_are_taken(tmp_path: Path) -> None:
    daemon = BusyDaemon()
    async with hosted(daemon, tmp_path) as served:
        transport = httpx.AsyncHTTPTransport(uds=str(served.socket))
        async with httpx.AsyncClient(transport=transport, base_url="http://s", timeout=60.0) as http:
            waiting = [asyncio.create_task(http.post("/clear")) for _ in range(CLIENTS_MAX)]
            await daemon.full.wait()
            assert (await http.post("/clear")).status_code == 503
            for _ in range(3):
                assert (await http.post("/stop")).json() == {"message": "stop: done"}
            assert not any(one.done() for one in waiting)
            daemon.free.set()
            assert {answer.status_code for answer in await asyncio.gather(*waiting)} == {200}
