"""A request that was abandoned, or reported as failed, is never executed later."""

from __future__ import annotations

import asyncio
import os
import signal
import socket
from pathlib import Path

import pytest
from fake_daemon_api import FakeDaemonApi
from hosted_api import hosted, web_process

from slipguard.daemon.api.requests import ClearRequest, ReleaseRequest
from slipguard.errors import CommandRefused, SlipguardError
from slipguard.web import daemon_proxy, host
from slipguard.web.daemon_endpoint import serve_web_process
from slipguard.web.daemon_proxy import DaemonProxy

BODY = b'{"confirm": true}'
RELEASE = b"POST /release HTTP/1.1\r\nhost: slipguard\r\ncontent-length: %d\r\n\r\n%b" % (len(BODY), BODY)


def asked_and_gone(path: Path) -> None:
    """A client that asks for a release, and gives it up before anybody has answered."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as client:
        client.connect(str(path))
        client.sendall(RELEASE)


async def test_a_release_abandoned_while_no_process_served_is_not_executed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(host, "RETRY_S", 0.1)
    daemon = FakeDaemonApi()
    async with hosted(daemon, tmp_path) as served:
        with served.client() as client:
            await asyncio.to_thread(client.state)
            os.kill(web_process(), signal.SIGKILL)
            asked_and_gone(served.socket)
        with served.client() as client:  # a waiting client is served, after those who came before
            assert await asyncio.to_thread(client.submit, ClearRequest()) == {"message": "clear: done"}
    assert daemon.requests == [ClearRequest()]


async def test_a_release_abandoned_while_the_web_process_was_suspended_is_not_executed(tmp_path: Path) -> None:
    daemon = FakeDaemonApi()
    async with hosted(daemon, tmp_path) as served:
        with served.client() as client:
            await asyncio.to_thread(client.state)
            os.kill(web_process(), signal.SIGSTOP)
            asked_and_gone(served.socket)
            os.kill(web_process(), signal.SIGCONT)
            assert await asyncio.to_thread(client.submit, ClearRequest()) == {"message": "clear: done"}
            for _ in range(3):
                await asyncio.to_thread(client.healthz)
    assert daemon.requests == [ClearRequest()]


async def test_a_request_that_reaches_the_daemon_too_late_is_not_executed(monkeypatch: pytest.MonkeyPatch) -> None:
    daemon = FakeDaemonApi()
    ours, theirs = socket.socketpair()
    reader, writer = await asyncio.open_connection(sock=ours)
    proxy = DaemonProxy(reader, writer)
    hearing = asyncio.create_task(proxy.run())
    monkeypatch.setattr(daemon_proxy, "EXECUTE_WITHIN_S", 0.05)
    monkeypatch.setattr(ReleaseRequest, "response_timeout_s", 0.1)
    with pytest.raises(SlipguardError, match="did not respond"):
        await proxy.submit(ReleaseRequest(confirm=True))
    there, back = await asyncio.open_connection(sock=theirs)
    serving_task = asyncio.create_task(serve_web_process(daemon, there, back))
    monkeypatch.undo()
    monkeypatch.setattr(daemon_proxy, "EXECUTE_WITHIN_S", -1.0)
    with pytest.raises(CommandRefused, match="release: reached the daemon too late and was not executed"):
        await proxy.submit(ReleaseRequest(confirm=True))
    monkeypatch.setattr(daemon_proxy, "EXECUTE_WITHIN_S", 60.0)
    assert await proxy.submit(ClearRequest()) == {"message": "clear: done"}
    assert daemon.requests == [ClearRequest()]
    for task in (hearing, serving_task):
        task.cancel()
    await asyncio.gather(hearing, serving_task, return_exceptions=True)
    for one in (writer, back):
        one.close()
        await one.wait_closed()
