"""The figures of the API load test, and its clients against a served API."""

from __future__ import annotations

import asyncio
from collections import Counter
from pathlib import Path

import pytest
from fake_daemon_api import FakeDaemonApi, served_on_tcp

from slipguard.errors import SlipguardError
from slipguard.tools.waiting import wait_until
from tests.campaigns import api_load_clients
from tests.campaigns.api_load import ApiLoadOptions, ApiLoadResult, block_latency
from tests.campaigns.command_line import run


def test_one_disturbed_block_does_not_count_but_a_rise_in_all_blocks_does() -> None:
    normal = [0.001 * n for n in range(1, 101)]
    without = block_latency([normal, normal, [5.0, 5.0]])
    assert (without.p50_ms, without.p99_ms) == (pytest.approx(50.5), pytest.approx(99.01))
    assert without.largest_ms == 5000.0
    slower = block_latency([[2 * one for one in normal]])
    found = ApiLoadResult(ApiLoadOptions(), 302, without, slower, (0, 0))
    assert found.rise_ms == pytest.approx(99.01)
    assert found.allowed_ms == pytest.approx(9.901)
    assert ApiLoadResult(ApiLoadOptions(), 2, block_latency([[0.002]]), slower, (0, 0)).allowed_ms == 1.0
    with pytest.raises(SlipguardError, match="nothing was decided"):
        block_latency([normal, []])


@pytest.mark.parametrize(
    ("clients", "received", "served"),
    [
        (4, {"responses 200": 40, "live messages": 4}, True),
        (4, {"responses 200": 40, "live messages": 4, "connections lost": 2}, True),
        (1, {"responses 200": 2}, True),
        (4, {}, False),
        (4, {"responses 503": 400}, False),
        (4, {"responses 200": 40}, False),
        (4, {"live messages": 400}, False),
        (4, {"responses 200": 40, "live messages": 4, "responses 503": 3}, False),
        (4, {"responses 200": 40, "live messages": 4, "connections lost": 40}, False),
    ],
)
def test_a_measurement_with_unserved_clients_is_invalid(
    clients: int,
    received: dict[str, int],
    served: bool,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    latency = block_latency([[0.002, 0.003]])

    async def measured(options: ApiLoadOptions, report: object) -> ApiLoadResult:
        return ApiLoadResult(options, 4, latency, latency, (0, 0), received)

    monkeypatch.setattr("tests.campaigns.api_load.measure_api_load", measured)
    assert run(["api-load", "--clients", str(clients), "--pairs", "2", "--json"]) == (0 if served else 1)
    assert ("were not served" in capsys.readouterr().err) is not served


async def test_clients_stream_and_poll(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(api_load_clients, "POLL_S", 0.01)
    received: Counter[str] = Counter()
    async with served_on_tcp(FakeDaemonApi(), tmp_path) as (port, _):
        clients = asyncio.create_task(api_load_clients.run_clients("127.0.0.1", port, 4, received))
        await wait_until(
            clients, lambda: received["responses 200"] >= 20 and received["live messages"] >= 6, 30.0, "no responses"
        )
        clients.cancel()
        await asyncio.gather(clients, return_exceptions=True)
    assert set(received) == {"responses 200", "live messages"}
