"""The full list of stress trials gives the same results in two processes as in one."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from slipguard.stress import perturbations
from tests.campaigns.command_line import run as cli

pytestmark = pytest.mark.campaign


def test_the_full_list_gives_equal_results_in_one_and_in_two_processes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(perturbations, "TRIALS_PER_LEVEL", 2)
    found = {}
    for jobs in ("1", "2"):
        out = tmp_path / jobs
        assert cli(["stress-list", "--jobs", jobs, "--only", "odd clock", "--only", "gap", "--out", str(out)]) == 0
        found[jobs] = json.loads((out / "stress.json").read_text()) | {"spent_s": 0}
    assert (found["1"]["tried"], found["1"]["share"]) == (11, 1.0)
    assert found["1"]["worst"] == pytest.approx(found["2"]["worst"], rel=0.05)  # another order of float32 sums
    assert found["1"]["families"]["gap"]["answers"] == found["2"]["families"]["gap"]["answers"]
