"""`slipguard bench` from the command line to its table, JSON and picture, on a single object."""

from __future__ import annotations

import json
from itertools import islice
from pathlib import Path

import pytest

from slipguard.cli.app import run
from slipguard.lab.bench import run as bench
from slipguard.lab.bench import skipping
from slipguard.lab.minute import Minute


@pytest.fixture(autouse=True)
def _one_object(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench, "names", lambda split: ("bar",))
    monkeypatch.setattr(bench, "EXTRA_PLAIN", ())
    monkeypatch.setattr(bench, "LARGE_FRAMES_QUICK", 2)
    monkeypatch.setattr(skipping, "QUICK_ONSETS", skipping.QUICK_ONSETS[:1])
    whole = Minute.shots
    monkeypatch.setattr(Minute, "shots", lambda self: islice(whole(self), 240))


def test_a_short_one(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert run(["bench", "--quick", "--json", "--out", str(tmp_path)]) == 0
    found = json.loads(capfd.readouterr().out)
    assert found == json.loads((tmp_path / "bench.json").read_text())
    assert (tmp_path / "bench.png").stat().st_size > 5000
