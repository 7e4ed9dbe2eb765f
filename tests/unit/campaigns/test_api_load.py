"""The crowd's arithmetic, and its clients against a served API."""

from __future__ import annotations

import asyncio
from collections import Counter
from pathlib import Path

import pytest
from fake_daemon_api import FakeDaemonApi, served_on_tcp

from slipguard.errors import SlipguardError
from slipguard.tools.waiting import wait_until
from tests.campaigns import api_load_clients as crowd_clients
from tests.campaigns.api_load import ApiLoadOptions, ApiLoadResult, spread_of_blocks
from tests.campaigns.command_line import run


def test_one_bad_block_does_not_count_and_a_rise_does() -> None:
    calm = [0.001 * n for n in range(1, 101)]
    alone = spread_of_blocks([calm, calm, [5.0, 5.0]])
    assert (alone.p50_ms, alone.p99_ms) == (pytest.approx(50.5), pytest.approx(99.01))
    assert alone.largest_ms == 5000.0
    slower = spread_of_blocks([[2 * one for one in calm]])
    found = ApiLoadResult(ApiLoadOptions(), 302, alone, slower, (0, 0))
    assert found.rise_ms == pytest.approx(99.01)
    assert found.allowed_ms == pytest.approx(9.901)
    assert ApiLoadResult(ApiLoadOptions(), 2, spread_of_blocks([[0.002]]), slower, (0, 0)).allowed_ms == 1.0
    with pytest.raises(SlipguardError, match="nothing was decided"):
        spread_of_blocks([calm, []])


@pytest.mark.parametrize(
    ("clients", "got", "served"),
    [
        (4, {"answers 200": 40, "live messages": 4}, True),
        (4, {"answers 200": 40, "live messages": 4, "connections lost": 2}, True),
        (1, {"answers 200": 2}, True),
        (4, {}, False),
        (4, {"answers 503": 400}, False),
        (4, {"answers 200": 40}, False),
        (4, {"live messages": 400}, False),
        (4, {"answers 200": 40, "live messages": 4, "answers 503": 3}, False),
        (4, {"answers 200": 40, "live messages": 4, "connections lost": 40}, False),
    ],
)
def test_clients_that_got_nothing_measure_nothing(
    clients: int, got: dict[str, int], served: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    calm = spread_of_blocks([[0.002, 0.003]])

    async def measured(options: ApiLoadOptions, tell: object) -> ApiLoadResult:
        return ApiLoadResult(options, 4, calm, calm, (0, 0), got)

    monkeypatch.setattr("tests.campaigns.api_load_command.measure_api_load", measured)
    assert run(["api-load", "--clients", str(clients), "--pairs", "2", "--json"]) == (0 if served else 1)
    assert ("were not served" in capsys.readouterr().err) is not served


async def test_clients_hear_and_poll_and_come_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(crowd_clients, "POLL_S", 0.01)
    got: Counter[str] = Counter()
    async with served_on_tcp(FakeDaemonApi(), tmp_path) as (port, _):
        crowd = asyncio.create_task(crowd_clients.crowd("127.0.0.1", port, 4, got))
        await wait_until(crowd, lambda: got["answers 200"] >= 20 and got["live messages"] >= 6, 30.0, "no answers")
        crowd.cancel()
        await asyncio.gather(crowd, return_exceptions=True)
    assert set(got) == {"answers 200", "live messages"}
