"""A stop request ends a lift on the emulated cell within 60 ms of its arrival, from the command line and the APIs.

The operator page is timed in `tests/browser/test_page_stop_time.py`, the ROS service in the tests of `slipguard_ros`.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import httpx
import pytest
from stop_rig import WITHIN_S, stop_rig
from ur_scene import own_address

from slipguard.cli.app import run
from slipguard.daemon.api.client import Client, TcpAddress
from slipguard.daemon.api.requests import StopRequest

TIMES = 5


@pytest.mark.campaign
@pytest.mark.realtime
def test_a_stop_ends_a_lift_within_60_ms(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sent_s: list[float] = []
    send = httpx.Client.request

    def noted(client: httpx.Client, *request: object, **options: object) -> httpx.Response:
        sent_s.append(time.monotonic())
        return send(client, *request, **options)  # type: ignore[arg-type]

    took_s: dict[str, list[float]] = {}
    with stop_rig(tmp_path, own_address(68)) as rig, Client(TcpAddress(rig.url, rig.token)) as tcp:
        ctl = ["ctl", "--socket", str(rig.cell.folder / "slipguard.sock"), "stop"]
        places: dict[str, Callable[[], object]] = {
            "slipguard ctl stop": lambda: run(ctl),
            "Unix socket": lambda: rig.client.submit(StopRequest()),
            "HTTP over TCP": lambda: tcp.submit(StopRequest()),
        }
        for place in list(places) * TIMES:
            rig.lift()
            with monkeypatch.context() as patched:
                patched.setattr(httpx.Client, "request", noted)
                places[place]()
            took_s.setdefault(place, []).append(rig.rested_s() - sent_s[-1])
            rig.lower()
    print({place: [round(1000.0 * one) for one in times] for place, times in took_s.items()}, "ms")
    assert max(max(times) for times in took_s.values()) <= WITHIN_S, took_s
