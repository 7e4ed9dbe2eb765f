"""An experiment runs its cases in order, stops in time, names a failing case, and continues where it was stopped."""

from __future__ import annotations

import itertools
import json
import os
from io import StringIO
from pathlib import Path

import pytest
from rich.console import Console

from slipguard.errors import InputError, SlipguardError
from slipguard.tools.experiment import Case, ResultStore, run_cases
from slipguard.tools.figures import Figures, figure_table, plain, share, write_json

CASES = [Case(f"row {number % 2}", number, 10 * number) for number in range(6)]


def doubled(case: Case[int]) -> int:
    if case.parameters == 40:
        raise SlipguardError("too large")
    return 2 * case.parameters


def test_cases_run_in_order_and_a_failure_names_the_case() -> None:
    shares: list[float] = []
    assert [outcome for _, outcome in run_cases(doubled, CASES[:4])] == [0, 20, 40, 60]
    with pytest.raises(SlipguardError, match="row 0, seed 4: too large"):
        list(run_cases(doubled, CASES, progress=shares.append))
    assert shares == pytest.approx([1 / 6, 2 / 6, 3 / 6, 4 / 6])
    with pytest.raises(SlipguardError, match=r"^row 0: too large"):
        list(run_cases(doubled, CASES, named=Case.title))


@pytest.mark.parametrize(("seconds", "at_least", "run"), [(2.0, 0, 2), (0.5, 3, 3), (99.0, 0, 4)])
def test_it_stops_after_the_time_and_the_least_number(seconds: float, at_least: int, run: int) -> None:
    ticks = itertools.count()
    ran = run_cases(
        doubled, CASES[:4], seconds=seconds, at_least=at_least, clock=lambda: float(next(ticks)),
        progress=lambda share: None,
    )  # fmt: skip
    assert len(list(ran)) == run


def test_a_stored_result_is_used_until_its_source_or_the_version_changes(tmp_path: Path) -> None:
    source, computed = tmp_path / "001.mcap", list[int]()
    source.write_text("recording")

    def compute(path: Path) -> int:
        computed.append(len(computed))
        return computed[-1]

    def result(version: int = 1, *, keep: bool = True) -> int:
        store: ResultStore[int] = ResultStore(version, lambda value: {"value": value}, lambda raw: int(raw["value"]))
        return store.result(source, compute, keep=lambda value: keep)

    assert (result(), result()) == (0, 0)
    assert result(2) == 1
    assert result(2, keep=False) == 2
    (tmp_path / "001.json").write_text("{")
    assert result(2) == 3
    os.utime(source, ns=(2**62, 2**62))
    assert result(2) == 4
    assert not list(tmp_path.glob("*.part"))


def test_figures_of_a_sample_and_of_none() -> None:
    figures = Figures.of([3.0, 1.0, 2.0, 10.0])
    assert (figures.count, figures.mean, figures.p50, figures.worst) == (4, 4.0, 2.5, 10.0)
    assert figures.sd == pytest.approx(4.0825, abs=1e-4)
    assert Figures.of(iter([])) == Figures()
    assert Figures.of([5.0]).sd == 0.0
    assert (share([True, False, True, True]), share([])) == (0.75, None)


def test_json_has_no_nan_and_a_table_no_broken_number(tmp_path: Path) -> None:
    value = plain({"a": (float("nan"), 1 / 3), "b": Figures.of([1.0]), "c": None})
    assert value["a"] == [None, 0.3333]
    assert value["b"]["count"] == 1
    write_json(tmp_path / "x.json", value)
    assert json.loads((tmp_path / "x.json").read_text()) == value
    with pytest.raises(InputError, match="cannot be written"):
        write_json(tmp_path / "none" / "x.json", value)
    console = Console(width=30, file=StringIO())
    console.print(figure_table(("name", "ms"), [["a very long name that needs several lines", "12345.67"]]))
    assert "12345.67" in console.file.getvalue()  # type: ignore[attr-defined]
    assert "…" not in console.file.getvalue()  # type: ignore[attr-defined]
