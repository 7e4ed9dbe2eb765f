"""The full list of stress trials gives the same results in batches as in one run, and keeps them when it is stopped."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from slipguard.stress.product_functions import ProductFunctions
from slipguard.stress.report import as_json
from slipguard.stress.runner import run, select_families
from slipguard.stress.trial_family import KEPT_FAILURES, FamilyResults, TrialFamily
from slipguard.tools.parallel import Workers
from tests.campaigns.command_line import run as cli
from tests.campaigns.stress_list import batches, run_full_list

pytestmark = pytest.mark.campaign


def short(*names: str) -> tuple[TrialFamily, ...]:
    """Return families of six trials in three batches; continuous ones of two trials in one batch."""
    return tuple(
        replace(family, full=2 if family.continuous else 6, cost_ms=5_000.0) for family in select_families(names)
    )


def assert_alike(one: Any, other: Any) -> None:
    """Assert equality; numbers nearly: another process may add single-precision numbers in another order."""
    assert type(one) is type(other)
    if isinstance(one, dict):
        assert set(one) == set(other)
        for key, value in one.items():
            assert_alike(value, other[key])
    else:
        assert one == (pytest.approx(other, rel=0.03) if isinstance(one, float) else other)


def test_the_full_list_gives_equal_results_in_one_and_in_two_processes() -> None:
    families = short("axes", "times", "drift")
    assert [len([one for one in batches(families) if one.family == family]) for family in families] == [3, 3, 1]
    alone = as_json(run(families, 7, math.inf))
    found = [as_json(outcome) for outcome in run_full_list(families, 7, workers=Workers(2))]
    assert len(found) == 7
    assert_alike({**found[-1], "spent_s": 0}, {**alone, "spent_s": 0})
    assert sorted(one["share"] for one in found) == [one["share"] for one in found]


def test_failures_of_all_batches_are_kept_as_in_one_run() -> None:
    def begin(product: ProductFunctions) -> Callable[[np.random.Generator, int, FamilyResults], None]:
        return lambda rng, seed, results: results.add_failure("nan" if seed == 55 else "crash", f"at {seed}")

    family = TrialFamily("odd", "", 60, 1_000.0, begin)
    alone = run((family,), 0, math.inf).results[0]
    *_, outcome = run_full_list((family,), 0, workers=Workers(1))
    assert len(batches((family,))) == 6
    assert outcome.results[0].counts == alone.counts
    assert outcome.results[0].failures == alone.failures
    assert [one.seed for one in alone.failures] == [*range(KEPT_FAILURES), 55]


def test_an_interrupted_full_list_leaves_its_results_so_far(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def begin(product: ProductFunctions) -> Callable[[np.random.Generator, int, FamilyResults], None]:
        def trial(rng: np.random.Generator, seed: int, results: FamilyResults) -> None:
            if seed >= 20:
                raise KeyboardInterrupt

        return trial

    monkeypatch.setattr("slipguard.stress.runner.FAMILIES", (TrialFamily("odd", "", 40, 1_000.0, begin),))
    assert cli(["stress-list", "--jobs", "1", "--out", str(tmp_path)]) == 1
    assert "interrupted" in capsys.readouterr().err
    found = json.loads((tmp_path / "stress.json").read_text())
    assert (found["tried"], found["share"], found["crashes"]) == (20, 0.5, 0)


def test_the_command_runs_the_full_list(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("slipguard.stress.runner.FAMILIES", short("times", "fusion"))
    assert cli(["stress-list", "--jobs", "1", "--out", str(tmp_path)]) == 0
    found = json.loads((tmp_path / "stress.json").read_text())
    assert (found["tried"], found["share"]) == (12, 1.0)
