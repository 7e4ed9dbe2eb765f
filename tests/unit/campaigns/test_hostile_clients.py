"""Hostile clients in short form, and that the campaign would notice what it looks for."""

from __future__ import annotations

import asyncio
import json

import pytest

from tests.campaigns import hostile_clients
from tests.campaigns.command_line import run
from tests.campaigns.hostile_clients import HostileResult, run_attack


@pytest.mark.campaign
@pytest.mark.realtime
def test_release_and_clear_are_answered_in_time_during_an_attack() -> None:
    found = asyncio.run(run_attack(5.0, 400, 0, lambda step, share: None))
    assert found.failure is None
    assert len(found.attacks) == 27
    assert sum(found.attacks.values()) > 1000


@pytest.mark.parametrize(
    ("times_ms", "statuses", "kept", "failure"),
    [
        ([5.0] * 200 + [199.0, 900.0], {"200": 1, "409": 1}, True, None),
        ([5.0, 203.0], {"200": 2}, True, "tcp: p99 of 2 responses 201 ms; the longest 203 ms"),
        ([5.0], {"0": 1}, True, "statuses {'0': 1}, web process kept"),
        ([5.0], {"200": 1}, False, "statuses {'200': 1}, web process replaced"),
    ],
)
def test_a_late_or_missing_response_fails_the_campaign(
    times_ms: list[float],
    statuses: dict[str, int],
    kept: bool,
    failure: str | None,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    async def measured(*arguments: object) -> HostileResult:
        return HostileResult(1.0, 1, {"unix": [1.0], "tcp": times_ms}, statuses, {"noise, reads": 3}, kept)

    monkeypatch.setattr(hostile_clients, "run_attack", measured)
    assert run(["hostile-clients", "--json"]) == (0 if failure is None else 1)
    output = capsys.readouterr()
    assert json.loads(output.out)["figures"]["tcp"]["longest_ms"] == max(times_ms)
    assert (failure or "") in output.err
