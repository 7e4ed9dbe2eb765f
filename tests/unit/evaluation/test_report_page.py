"""The report never shows the paper's figures as comparable with those of a simulated cell."""

from __future__ import annotations

from typing import Any

import pytest

from slipguard.cli.evaluate import _print_table
from slipguard.evaluation.report_data import ESTIMATORS, PAPER
from slipguard.evaluation.report_html import _estimator_table, _headline, _paper_comparison

NOTE = "simulated; not comparable"
FIGURES = {"n": 2, "mean": 0.4, "sd": 0.1, "worst": 0.5, "low": 0.3, "high": 0.5}


def report(simulated: bool) -> dict[str, Any]:
    """Return the figures of a report that its head needs."""
    return {
        "simulated": simulated, "lifts_compared": 2, "turn_error_mean_deg": 0.4, "turn_error_sd_deg": 0.1,
        "turn_error_worst_object_deg": 0.5, "declined_share": 0.1, "within_1_sigma": 0.7, "within_2_sigma": 0.95,
        "per_estimator": dict.fromkeys(ESTIMATORS, FIGURES), "dice": None, "per_object": {},
        "paper_real_cell_as_published": PAPER,
    }  # fmt: skip


@pytest.mark.parametrize("part", [_headline, _paper_comparison, _estimator_table])
def test_each_part_with_a_figure_of_the_paper_says_so(part: Any) -> None:
    shown = part(report(simulated=True))
    assert str(PAPER["turn_error_mean_deg"]) in shown
    assert NOTE in shown
    assert NOTE not in part(report(simulated=False))


def test_the_terminal_says_so_too(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    _print_table(report(simulated=True))
    assert f"{PAPER['turn_error_mean_deg']}° ± {PAPER['turn_error_sd_deg']}° (this cell is {NOTE})" in (
        capsys.readouterr().out
    )
    _print_table(report(simulated=False))
    assert NOTE not in capsys.readouterr().out
