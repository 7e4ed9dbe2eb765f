"""An API in its own web process, as in the daemon, with a fake daemon behind it."""

from __future__ import annotations

import asyncio
import os
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, closing
from pathlib import Path

from fake_daemon_api import FakeDaemonApi

from slipguard.daemon.api.client import Client, TcpAddress
from slipguard.web.host import run_api
from slipguard.web.sockets import bind, bind_tcp


class HostedApi:
    """A served daemon: its warnings and addresses."""

    def __init__(self, folder: Path, port: int) -> None:
        self.socket, self.token_at = folder / "s", folder / "token"
        self.url = f"http://127.0.0.1:{port}"
        self.warnings: list[str] = []
        self.serving: asyncio.Task[None]

    def client(self) -> Client:
        return Client(self.socket, timeout_s=20.0)

    def over_tcp(self) -> Client:
        return Client(TcpAddress(self.url, self.token_at.read_text().strip()), timeout_s=20.0)


def free_port() -> int:
    with closing(bind_tcp("127.0.0.1", 0)) as probe:
        return int(probe.getsockname()[1])


@asynccontextmanager
async def hosted(daemon: FakeDaemonApi, folder: Path) -> AsyncIterator[HostedApi]:
    port = free_port()
    host = HostedApi(folder, port)
    api = run_api(daemon, bind(host.socket), ("127.0.0.1", port), host.token_at, host.warnings.append)
    serving = host.serving = asyncio.create_task(api, name="api")
    try:
        yield host
        assert not serving.done(), serving
    finally:
        serving.cancel()
        await asyncio.gather(serving, return_exceptions=True)
    assert os.listdir(folder) == []


def web_process() -> int:
    """Return the process id of the web process, a child of this process."""
    mine = Path(f"/proc/self/task/{os.getpid()}/children").read_text().split()
    (found,) = [int(pid) for pid in mine if b"slipguard.web" in Path(f"/proc/{pid}/cmdline").read_bytes()]
    return found
