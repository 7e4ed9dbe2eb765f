"""The ROS package as far as it needs no ROS: its client of the local API, and the readings that it publishes."""

from __future__ import annotations

import asyncio
import json
import math
import struct
import threading
from pathlib import Path

import pytest
from fake_daemon_api import FakeDaemonApi, served

from drivers.slipguard_ros.slipguard_ros.local_api import (
    DaemonUnreachable,
    LocalApi,
    RequestRefused,
    StreamThread,
)
from drivers.slipguard_ros.slipguard_ros.readings import (
    ERROR,
    OK,
    WARN,
    JawJoint,
    device_statuses,
    parse_frame,
    rotation_of,
)
from slipguard.daemon.api.requests import GuardRequest, LiftRequest, ReleaseRequest
from slipguard.errors import CommandRefused

pause = threading.Event().wait


async def test_requests_reach_the_daemon_and_its_reasons_come_back(tmp_path: Path) -> None:
    daemon = FakeDaemonApi()
    async with served(daemon, tmp_path / "s") as path:
        api = LocalApi(str(path))
        assert (await asyncio.to_thread(api.state))["phase"] == "holding"
        assert await asyncio.to_thread(api.submit, "lift", {}) == "lift: done"
        await asyncio.to_thread(api.submit, "guard", {"on": False})
        await asyncio.to_thread(api.submit, "release", {"confirm": True})
        with pytest.raises(RequestRefused, match="must be true"):
            await asyncio.to_thread(api.submit, "release", {"confirm": False})
        daemon.failure = CommandRefused("cannot lift: nothing is held")
        with pytest.raises(RequestRefused, match="cannot lift: nothing is held"):
            await asyncio.to_thread(api.submit, "lift", {})
    assert daemon.requests[:3] == [LiftRequest(), GuardRequest(on=False), ReleaseRequest(confirm=True)]


async def test_both_streams_deliver_and_return_after_the_daemon_did(tmp_path: Path) -> None:
    path = tmp_path / "s"
    received: dict[str, list[bytes]] = {"/live": [], "/frames/left": []}
    lost: list[str] = []
    streams = [
        StreamThread(LocalApi(str(path)), name, messages.append, lost.append)  # type: ignore[arg-type]
        for name, messages in received.items()
    ]

    def until_all_received() -> None:
        while not all(len(messages) > 3 for messages in received.values()):
            pause(0.01)

    def until_lost() -> None:
        while not any("start it with `slipguard run`" in why for why in lost):
            pause(0.01)

    try:
        async with asyncio.timeout(20.0):
            await asyncio.to_thread(until_lost)
        for _ in range(2):  # the daemon stops and starts again
            for messages in received.values():
                messages.clear()
            async with served(FakeDaemonApi(), path), asyncio.timeout(20.0):
                await asyncio.to_thread(until_all_received)
    finally:
        await asyncio.to_thread(lambda: [stream.stop() for stream in streams])
    assert json.loads(received["/live"][0])["type"] == "history"
    image = parse_frame(bytearray(received["/frames/left"][0]))
    assert (image.width_px, image.height_px, len(image.pixels)) == (240, 320, 230400)
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("slipguard /")]


async def test_without_a_daemon_the_error_names_the_socket(tmp_path: Path) -> None:
    api = LocalApi(str(tmp_path / "none.sock"))
    with pytest.raises(DaemonUnreachable, match=r"no daemon at .*none\.sock .*slipguard run"):
        api.state()
    async with served(FakeDaemonApi(), tmp_path / "s") as path:
        with pytest.raises(DaemonUnreachable, match="404"):
            await asyncio.to_thread(LocalApi(str(path)).open_stream, "/frames/middle")


def test_a_damaged_frame_is_refused() -> None:
    header = struct.pack("<4sHHIdQ", b"SGF1", 240, 320, 230400, 1.5, 7)
    image = parse_frame(bytearray(header + bytes(230400)))
    assert (image.sequence, image.captured_at_s) == (7, 1.5)
    for damaged in (header, header + bytes(230399), b"XXXX" + header[4:] + bytes(230400), b"{}"):
        with pytest.raises(ValueError, match="is not a frame"):
            parse_frame(bytearray(damaged))


def test_readings_of_a_state() -> None:
    state = FakeDaemonApi().snapshot()
    rotation = rotation_of(state)
    assert rotation is not None
    assert rotation.rotation_rad == pytest.approx(math.radians(1.5))
    assert rotation.sigma_rad == pytest.approx(math.radians(0.25))
    assert rotation_of({"rotation": None}) is None
    assert rotation_of({"rotation": {"rotation_deg": None, "sigma_deg": None}}) is None


def test_the_jaw_joint_converts_both_ways() -> None:
    joint = JawJoint("finger_joint", -0.8 / 0.085, 0.8)  # of a 2F-85
    assert joint.position(85.0) == pytest.approx(0.0)
    assert joint.position(0.0) == pytest.approx(0.8)
    assert joint.width_mm(joint.position(31.0)) == pytest.approx(31.0)


def test_diagnostics_name_fault_waiting_and_devices() -> None:
    state = FakeDaemonApi().snapshot()
    state["devices"] = {
        "left": {"state": "ready", "reason": None},
        "arm": {"state": "disconnected", "reason": "no response"},
    }
    state["fingers"] = {"left": {"serial": "D1", "frames_per_s": 59.9, "counts": {"corrupt": 2}}}
    guard, left, arm = device_statuses(state)
    assert (guard.level, guard.message) == (OK, "holding, guarding")
    assert (left.level, left.values["serial"], left.values["corrupt"]) == (OK, "D1", "2")
    assert (arm.level, arm.message) == (ERROR, "no response")
    waiting = device_statuses(state | {"waiting_for": ["arm: no response"]})[0]
    assert (waiting.level, waiting.message) == (WARN, "arm: no response")
    fault = {"code": "object lost", "observed": "no contact", "what_to_do": "release"}
    faulty = device_statuses(state | {"fault": fault})[0]
    assert (faulty.level, faulty.message) == (ERROR, "object lost: no contact. release")
