"""Failures of the web process: the daemon warns, restarts it, and continues."""

from __future__ import annotations

import asyncio
import math
import os
import signal
import socket
import sys
from pathlib import Path

import pytest
from fake_daemon_api import FakeDaemonApi
from hosted_api import hosted, web_process

from slipguard.daemon.api.requests import ClearRequest
from slipguard.daemon.loop.event_log import Event
from slipguard.tools.waiting import wait_until
from slipguard.web import daemon_endpoint, host
from slipguard.web.daemon_endpoint import serve_web_process
from slipguard.web.sockets import bind

GARBAGE = "#!{}\nimport os, sys, time\nos.write(int(sys.argv[4]), b'x' * 64)\ntime.sleep(600)\n"


async def test_invalid_messages_and_a_failed_start_are_survived(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "served").mkdir()
    speaking = tmp_path / "speaking"
    speaking.write_text(GARBAGE.format(sys.executable))
    speaking.chmod(0o755)
    daemon = FakeDaemonApi()
    monkeypatch.setattr(sys, "executable", str(speaking))
    async with hosted(daemon, tmp_path / "served") as served:
        await wait_until(
            served.serving, lambda: len(served.warnings) == 1, 30.0, "no warning about the invalid message"
        )
        monkeypatch.setattr(sys, "executable", str(tmp_path / "nowhere"))
        await wait_until(served.serving, lambda: len(served.warnings) == 2, 30.0, "no warning about the failed start")
        monkeypatch.undo()
        with served.client() as client:
            assert await asyncio.to_thread(client.submit, ClearRequest()) == {"message": "clear: done"}
        garbage, nowhere = served.warnings
        assert garbage.startswith("page and API stopped (a message of ")
        assert "No such file" in nowhere
        assert len(daemon.subscribers) == 1
        assert not any("\n" in line for line in served.warnings)


@pytest.mark.campaign
async def test_a_web_process_that_hangs_is_replaced_and_executes_nothing_later(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(daemon_endpoint, "SILENCE_MAX_S", 2.0)
    monkeypatch.setattr(host, "RETRY_S", 0.05)
    monkeypatch.setattr(host, "STOP_TIMEOUT_S", 0.1)
    daemon = FakeDaemonApi()
    async with hosted(daemon, tmp_path) as served:
        with served.client() as client:
            await asyncio.to_thread(client.state)
            hanging = web_process()
            os.kill(hanging, signal.SIGSTOP)
            pending = asyncio.create_task(asyncio.to_thread(client.state))
            await wait_until(served.serving, lambda: len(served.warnings) == 1, 30.0, "it is not noticed")
            assert "(it does not respond)" in served.warnings[0]
            await asyncio.gather(pending, return_exceptions=True)
        with pytest.raises(ProcessLookupError):
            os.kill(hanging, 0)
        with served.client() as client:
            assert await asyncio.to_thread(client.submit, ClearRequest()) == {"message": "clear: done"}
    assert daemon.requests == [ClearRequest()]


@pytest.mark.parametrize(("healthy_s", "expected_calls"), [(0.0, ["reset", "wait"] * 2), (1e9, ["wait"] * 2)])
async def test_a_process_that_ran_for_long_is_replaced_after_the_shortest_pause(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, healthy_s: float, expected_calls: list[str]
) -> None:
    found: list[str] = []

    class Pauses:
        def __init__(self, *pauses_s: float) -> None:
            pass

        def reset(self) -> None:
            found.append("reset")

        async def wait(self) -> None:
            found.append("wait")
            if found.count("wait") == 2:
                raise asyncio.CancelledError

    async def fails(*_: object) -> int:
        raise OSError("no more processes")

    monkeypatch.setattr(host, "Backoff", Pauses)
    monkeypatch.setattr(host, "HEALTHY_S", healthy_s)
    monkeypatch.setattr(host, "_run_web_process", fails)
    with pytest.raises(asyncio.CancelledError):
        await host.run_api(FakeDaemonApi(), bind(tmp_path / "s"), None, tmp_path / "token", lambda line: None)
    assert found == expected_calls


async def test_an_event_that_cannot_be_sent_is_dropped() -> None:
    daemon = FakeDaemonApi()
    ours, theirs = socket.socketpair()
    reader, writer = await asyncio.open_connection(sock=ours)
    responses = asyncio.create_task(serve_web_process(daemon, reader, writer))
    await wait_until(responses, lambda: bool(daemon.subscribers), 5.0, "the web process is not served")
    hear = daemon.subscribers[0]
    hear(Event(math.nan, "info", "no time at all"))
    theirs.close()
    for _ in range(3):
        hear(Event(1.0, "info", "no client is there"))
        await asyncio.sleep(0)
    await responses
    writer.close()
    hear(Event(2.0, "info", "it is closed"))
    assert daemon.subscribers == []
