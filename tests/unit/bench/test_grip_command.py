"""`slipguard bench --grip` as a command: JSON, files, exit code."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest
import typer

from slipguard.bench.grip import campaign, json_figures
from slipguard.cli.bench import bench_grip
from slipguard.errors import InputError
from slipguard.tools.parallel import Workers


@pytest.fixture(autouse=True)
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(campaign, "QUICK_SCENARIOS", 3)
    monkeypatch.setattr(campaign, "QUICK_RENDERED", 1)


@pytest.mark.campaign
def test_the_command_writes_json_and_plot(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(json_figures, "failures", lambda found: [])  # there are too few scenarios for the limits
    bench_grip(quick=True, seed=1000, plant="own", json=True, out=tmp_path, workers=Workers(jobs=1))
    printed = capsys.readouterr()
    found = json.loads(printed.out)
    assert (found["scenarios"], found["rendered"], found["seed_set"]) == (3, 1, "test")
    assert [check["key"] for check in found["promised"]] == [limit.key for limit in json_figures.LIMITS]
    assert "mujoco" not in found
    assert "test seed 1000" in printed.err
    kept = json.loads((tmp_path / "grip.json").read_text())
    assert {key: kept[key] for key in found} == found
    assert len(kept["trials"]) == 3
    assert (tmp_path / "grip.png").stat().st_size > 10_000


@pytest.mark.campaign
def test_both_plants_stand_beside_each_other(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("mujoco")
    monkeypatch.setattr(campaign, "QUICK_RENDERED", 0)
    monkeypatch.setattr(json_figures, "failures", lambda found: [])
    bench_grip(quick=True, seed=0, plant="both", json=True, out=None, workers=Workers(jobs=1))
    found = json.loads(capsys.readouterr().out)
    assert (found["plant"], found["mujoco"]["plant"]) == ("own", "mujoco")
    assert found["scenarios"] == found["mujoco"]["scenarios"] == 3


@pytest.mark.campaign
def test_the_command_fails_if_a_limit_is_exceeded(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(json_figures, "failures", lambda found: ["limit exceeded: something"])
    with pytest.raises(typer.Exit):
        bench_grip(quick=True, seed=0, plant="own", json=False, out=None, workers=Workers(jobs=1))
    printed = capsys.readouterr()
    assert "limit exceeded: something" in printed.err
    assert "limits" in printed.out


def test_an_unknown_plant_is_refused() -> None:
    with pytest.raises(InputError, match="must be own, mujoco or both"):
        bench_grip(quick=True, seed=0, plant="bullet", json=True, out=None, workers=Workers(jobs=1))


def test_without_mujoco_its_plant_is_refused_before_the_scenarios(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(InputError, match=r"^--plant mujoco needs MuJoCo. Install it with: pip install"):
        bench_grip(quick=True, seed=0, plant="mujoco", json=True, out=None, workers=Workers(jobs=1))
