"""The web process: requests over its sockets, restart after a kill, and shutdown."""

from __future__ import annotations

import asyncio
import os
import signal
import socket
import sys
from contextlib import closing
from pathlib import Path

import httpx
import numpy as np
import pytest
from fake_daemon_api import FakeDaemonApi
from hosted_api import free_port, hosted, web_process

from slipguard.daemon.api.client import Client, TcpAddress
from slipguard.daemon.api.daemon_api import ContactOverlay, FingerFrame
from slipguard.daemon.api.requests import CalibrateRequest, ClearRequest, GraspRequest, LiftRequest, ReleaseRequest
from slipguard.devices import Frame
from slipguard.errors import CommandRefused, DeviceTimeout, SlipguardError
from slipguard.perception.patch import ClippedSides
from slipguard.web.host import run_api, wait_or_kill
from slipguard.web.protocol import (
    MESSAGE_MAX_BYTES,
    decode_finger_frame,
    encode_finger_frame,
    encode_message,
    read_message,
)
from slipguard.web.sockets import bind, bind_tcp


async def test_requests_and_failures_pass_through_unchanged(tmp_path: Path) -> None:
    daemon = FakeDaemonApi()
    async with hosted(daemon, tmp_path) as host:
        with host.client() as client:
            assert await asyncio.to_thread(client.state) == daemon.snapshot()
            assert await asyncio.to_thread(client.healthz) == {"status": "ok"}
            assert (await asyncio.to_thread(client.submit, LiftRequest(height_mm=120.0, speed_mm_s=20.0))) == {
                "message": "lift: done"
            }
            assert "fingers" in await asyncio.to_thread(client.submit, CalibrateRequest())
            assert (await asyncio.to_thread(client.frame, "right")).serial == "D20002"
            daemon.failure = CommandRefused("cannot lift while idle")
            with pytest.raises(CommandRefused, match=r"^cannot lift while idle$"):
                await asyncio.to_thread(client.submit, LiftRequest())
            daemon.failure = DeviceTimeout("gripper: no answer")
            with pytest.raises(SlipguardError, match=r"^gripper: no answer$"):
                await asyncio.to_thread(client.submit, GraspRequest())
            daemon.failure = KeyError("secret detail")
            with pytest.raises(SlipguardError, match="failed inside the daemon") as raised:
                await asyncio.to_thread(client.submit, GraspRequest())
            assert "secret" not in str(raised.value)
        daemon.failure = None
        with host.over_tcp() as client:
            assert await asyncio.to_thread(client.submit, ClearRequest()) == {"message": "clear: done"}
            assert (await asyncio.to_thread(client.page_link))["url"].startswith(f"{host.url}/login?token=")
        with Client(TcpAddress(host.url)) as client, pytest.raises(SlipguardError, match="needs the token"):
            await asyncio.to_thread(client.submit, ReleaseRequest(confirm=True))
    assert [request.kind for request in daemon.requests] == ["lift", "calibrate", "lift", "grasp", "grasp", "clear"]
    assert host.warnings == []


async def test_a_killed_web_process_is_replaced_without_a_refused_connection(tmp_path: Path) -> None:
    daemon = FakeDaemonApi()
    async with hosted(daemon, tmp_path) as host:
        with host.client() as client:
            await asyncio.to_thread(client.state)
        os.kill(web_process(), signal.SIGKILL)
        with host.client() as client:
            assert await asyncio.to_thread(client.submit, ClearRequest()) == {"message": "clear: done"}
        assert len(host.warnings) == 1
        assert "the guard is not affected" in host.warnings[0]
        assert len(daemon.subscribers) == 1, "the first one's ears are taken off"


async def test_stopping_finishes_requests_in_progress(tmp_path: Path) -> None:
    daemon = FakeDaemonApi()
    daemon.delay_s = 0.3
    with Client(tmp_path / "s", timeout_s=20.0) as client:
        async with hosted(daemon, tmp_path):
            pending = asyncio.create_task(asyncio.to_thread(client.submit, ClearRequest()))
            await daemon.started.wait()
        assert await pending == {"message": "clear: done"}


async def test_without_the_port_only_the_unix_socket_is_served(tmp_path: Path) -> None:
    daemon = FakeDaemonApi()
    (tmp_path / "own").mkdir()
    with closing(bind_tcp("127.0.0.1", 0)) as taken:
        port = int(taken.getsockname()[1])
        warnings: list[str] = []
        unix = bind(tmp_path / "own" / "s")
        api = run_api(daemon, unix, ("127.0.0.1", port), tmp_path / "own" / "token", warnings.append)
        serving = asyncio.create_task(api)
        with Client(tmp_path / "own" / "s", timeout_s=20.0) as client:
            assert await asyncio.to_thread(client.state) == daemon.snapshot()
            with pytest.raises(CommandRefused, match="page is not served"):
                await asyncio.to_thread(client.page_link)
        assert not (tmp_path / "own" / "token").exists()
        serving.cancel()
        await asyncio.gather(serving, return_exceptions=True)
    assert [f"cannot listen on 127.0.0.1:{port}" in line for line in warnings] == [True]


async def test_a_port_open_to_the_network_causes_a_warning(tmp_path: Path) -> None:
    port = free_port()
    warnings: list[str] = []
    serving = asyncio.create_task(
        run_api(FakeDaemonApi(), bind(tmp_path / "s"), ("0.0.0.0", port), tmp_path / "token", warnings.append)
    )
    async with httpx.AsyncClient(trust_env=False, timeout=20.0) as http:
        assert (await http.get(f"http://127.0.0.1:{port}/access")).status_code == 200
    serving.cancel()
    await asyncio.gather(serving, return_exceptions=True)
    assert ["open to the network" in line for line in warnings] == [True]


async def test_the_web_process_exits_when_the_daemon_has_gone(tmp_path: Path) -> None:
    """However it went, its socket is free for the next one."""
    import sys

    unix = bind(tmp_path / "s")
    ours, theirs = socket.socketpair()
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "slipguard.web", str(theirs.fileno())),
        pass_fds=(theirs.fileno(), unix.listening.fileno()),
    )
    theirs.close()
    first = {"unix_fd": unix.listening.fileno(), "tcp_fd": None, "host": None, "port": None, "token": None}
    ours.sendall(b"".join(encode_message(first)))
    await asyncio.to_thread(ours.recv, 1)  # it asks for the state, so it serves
    ours.close()
    unix.listening.close()
    async with asyncio.timeout(20.0):
        assert await process.wait() == 1
    bind(tmp_path / "s").close()


async def test_invalid_messages() -> None:
    for sent, why in (
        (b"\x00\x00\x00\x02\x00\x00\x00\x00[]", "not a JSON object"),
        (b"\x00\x00\x00\x03\x00\x00\x00\x00{a}", "is not JSON"),
        (b'\x00\x00\x00\x09\x00\x00\x00\x00{"a":NaN}', "NaN is not a number"),
        ((MESSAGE_MAX_BYTES + 1).to_bytes(4, "big") + b"\x00" * 4, "bytes; at most"),
    ):
        reader = asyncio.StreamReader()
        reader.feed_data(sent)
        reader.feed_eof()
        with pytest.raises(SlipguardError, match=why):
            await read_message(reader)
    cut = asyncio.StreamReader()
    cut.feed_data(b"".join(encode_message({"a": 1}))[:-1])
    cut.feed_eof()
    assert await read_message(cut) is None


@pytest.mark.parametrize("axis_deg", [None, -12.5])
def test_a_frame_arrives_unchanged(axis_deg: float | None) -> None:
    rng = np.random.default_rng(3)
    mask = rng.integers(0, 2, (31, 47), np.uint8)
    contact = ContactOverlay(mask, 5, 7, (160, 213), ClippedSides(left=True), axis_deg)
    view = FingerFrame("D20001", Frame(rng.integers(0, 256, (320, 240, 3), np.uint8), 12.25, 99), contact)
    received, pixels = encode_finger_frame(view)
    found = decode_finger_frame(received, b"".join(pixels))
    assert np.array_equal(found.frame.image, view.frame.image)
    assert (found.serial, found.frame.sequence, found.frame.captured_at_s) == ("D20001", 99, 12.25)
    assert found.contact is not None
    assert np.array_equal(found.contact.mask, mask)
    assert (found.contact.left_px, found.contact.top_px, found.contact.image_size) == (5, 7, (160, 213))
    assert (found.contact.clipped, found.contact.axis_deg) == (contact.clipped, axis_deg)
    received, pixels = encode_finger_frame(FingerFrame("D20001", view.frame))
    assert decode_finger_frame(received, b"".join(pixels)).contact is None


async def test_a_cancelled_wait_leaves_no_process() -> None:
    process = await asyncio.create_subprocess_exec(sys.executable, "-c", "import time; time.sleep(60)")
    waiting = asyncio.create_task(wait_or_kill(process, 60.0))
    await asyncio.sleep(0.05)
    waiting.cancel()
    with pytest.raises(asyncio.CancelledError):
        await waiting
    assert process.returncode == -signal.SIGKILL
