"""The report never shows the paper's figures as comparable with those of a simulated cell."""

from __future__ import annotations

from pathlib import Path

import pytest

from slipguard.evaluation.lift_analysis import LiftResult, RotationErrors
from slipguard.evaluation.report_data import PAPER, report_json
from slipguard.evaluation.report_html import write_page

NOTE = "simulated; not comparable"


def lift(name: str, repeat: int, mean_deg: float | None, *, simulated: bool) -> LiftResult:
    result = LiftResult(f"{name}-{repeat}", name, name == "pen", "", repeat, repeat, simulated=simulated)
    result.errors = {} if mean_deg is None else {"fused": RotationErrors(90, mean_deg, 2.0 * mean_deg)}
    result.problem = None if mean_deg is not None else "the markers were not <visible>"
    result.final_rotation_deg = 12.0
    return result


@pytest.mark.parametrize("simulated", [True, False])
def test_the_papers_figures_are_marked_where_the_cell_is_simulated(simulated: bool, tmp_path: Path) -> None:
    lifts = [lift("bar", 1, 0.2, simulated=simulated), lift("bar", 2, 0.4, simulated=simulated)]
    lifts += [lift("pen", 1, 0.9, simulated=simulated), lift("pen", 2, None, simulated=simulated)]
    report = report_json(lifts)
    assert (report["lifts"], report["lifts_compared"], report["simulated"]) == (4, 3, simulated)
    assert report["turn_error_mean_deg"] == pytest.approx(0.5)
    assert report["turn_error_worst_object_deg"] == 0.9
    assert report["per_object"]["bar"]["fused"]["n"] == 2
    assert report["per_object"]["bar"]["fused"]["low"] <= 0.3 <= report["per_object"]["bar"]["fused"]["high"]
    assert report["seen"]["mean"] == 0.9
    write_page(tmp_path / "report.html", report, None, {})
    page = (tmp_path / "report.html").read_text()
    assert str(PAPER["turn_error_mean_deg"]) in page
    assert (NOTE in page) is simulated
    assert "not &lt;visible&gt;" in page
