"""`slipguard latency` on the wire, with a handful of commands."""

from __future__ import annotations

import json

import pytest

from slipguard.bench.wire_latency import OWN, STAGES, TOTAL
from slipguard.cli.app import run
from tests.campaigns.command_line import run as run_campaign


@pytest.mark.campaign
@pytest.mark.realtime
def test_two_clients_for_a_moment(capfd: pytest.CaptureFixture[str]) -> None:
    """Both clients are served and the exit code follows from the figures; whether the p99 rises is chance."""
    code = run_campaign(["api-load", "--clients", "2", "--pairs", "1", "--block-s", "1.5", "--fps", "30", "--json"])
    expected = capfd.readouterr()
    found = json.loads(expected.out)
    assert code == int(found["rise_ms"] > found["allowed_ms"]), expected.err
    assert found["decisions"] > 20
    assert found["received"]["responses 200"] >= 1
    assert found["received"]["live messages"] >= 1


@pytest.mark.campaign
@pytest.mark.realtime
def test_a_short_measurement(capfd: pytest.CaptureFixture[str]) -> None:
    assert run(["latency", "--commands", "4", "--fps", "30", "--baud", "115200", "--json"]) == 0
    found = json.loads(capfd.readouterr().out)
    assert found["commands"] >= 3
    assert set(found["stages"]) == {*STAGES, OWN, TOTAL}
    total, own = found["stages"][TOTAL], found["stages"][OWN]
    assert 0.0 < own["p50_ms"] < total["p50_ms"]
    assert found["stages"][STAGES[-1]]["p50_ms"] == pytest.approx(15 * 10 / 115200 * 1e3, abs=0.01)
