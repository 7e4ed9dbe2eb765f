"""What was given up, or reported as failed, never comes true later: whoever was stopped, killed or slow meanwhile."""

from __future__ import annotations

import asyncio
import os
import signal
import socket
from pathlib import Path

import pytest
from fake_daemon_api import FakeDaemonApi
from hosted_api import hosted, web_process

from slipguard.errors import CommandRefused, SlipguardError
from slipguard.web import daemon_proxy, host
from slipguard.web.daemon_endpoint import answer
from slipguard.web.daemon_proxy import DaemonProxy

BODY = b'{"confirm": true}'
RELEASE = b"POST /release HTTP/1.1\r\nhost: slipguard\r\ncontent-length: %d\r\n\r\n%b" % (len(BODY), BODY)


def asked_and_gone(path: Path) -> None:
    """A client that asks for a release, and gives it up before anybody has answered."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as client:
        client.connect(str(path))
        client.sendall(RELEASE)


async def test_a_release_given_up_while_nobody_served_is_not_done(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(host, "RETRY_S", 0.1)
    control = FakeDaemonApi()
    async with hosted(control, tmp_path) as served:
        with served.client() as client:
            await asyncio.to_thread(client.state)
            os.kill(web_process(), signal.SIGKILL)
            asked_and_gone(served.socket)
        with served.client() as client:  # whoever waits is served, and after those who came before
            assert await asyncio.to_thread(client.clear) == {"said": "clear, as asked"}
    assert control.asked == [("clear",)]


async def test_a_release_given_up_while_the_web_process_was_stopped_is_not_done(tmp_path: Path) -> None:
    control = FakeDaemonApi()
    async with hosted(control, tmp_path) as served:
        with served.client() as client:
            await asyncio.to_thread(client.state)
            os.kill(web_process(), signal.SIGSTOP)
            asked_and_gone(served.socket)
            os.kill(web_process(), signal.SIGCONT)
            assert await asyncio.to_thread(client.clear) == {"said": "clear, as asked"}
            for _ in range(3):
                await asyncio.to_thread(client.healthz)
    assert control.asked == [("clear",)]


async def test_a_command_that_the_daemon_comes_to_too_late_is_not_done(monkeypatch: pytest.MonkeyPatch) -> None:
    control = FakeDaemonApi()
    ours, theirs = socket.socketpair()
    reader, writer = await asyncio.open_connection(sock=ours)
    asking = DaemonProxy(reader, writer)
    hearing = asyncio.create_task(asking.run())
    monkeypatch.setattr(daemon_proxy, "COMMAND_S", 0.05)
    with pytest.raises(SlipguardError, match="did not answer"):
        await asking._ask("release", {"width_mm": None}, within_s=0.1)
    there, back = await asyncio.open_connection(sock=theirs)
    answering = asyncio.create_task(answer(control, there, back))
    monkeypatch.setattr(daemon_proxy, "COMMAND_S", -1.0)
    with pytest.raises(CommandRefused, match="release came to the daemon too late and is not done"):
        await asking.release()
    monkeypatch.setattr(daemon_proxy, "COMMAND_S", 60.0)
    assert await asking.clear() == "clear, as asked"
    assert control.asked == [("clear",)]
    for task in (hearing, answering):
        task.cancel()
    await asyncio.gather(hearing, answering, return_exceptions=True)
    for one in (writer, back):
        one.close()
        await one.wait_closed()
