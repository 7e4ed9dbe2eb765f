"""A small experiment in the simulated world, from the first grasp to the report; recorded lifts are not repeated."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from slipguard.cli.app import run

PROTOCOL = """
name = "two lifts"
repeats = 2
rotation_deg = [8.0, 16.0]
hold_s = 0.2
lift_speed_mm_s = 100.0
objects = [{name = "bar", hard = "heavy"}]
"""


@pytest.fixture(scope="module")
def experiment(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("evaluate")
    (folder / "p.toml").write_text(PROTOCOL)
    out = folder / "out"
    assert (
        run(["evaluate", "run", "--sim", "--protocol", str(folder / "p.toml"), "--out", str(out), "--jobs", "1"]) == 0
    )
    return out


@pytest.mark.campaign
def test_the_report_agrees_with_the_truth(experiment: Path) -> None:
    report = json.loads((experiment / "report.json").read_text())
    assert report["lifts"] == report["lifts_compared"] == 2
    assert report["turn_error_mean_deg"] <= 0.5
    assert report["lag_error_frames"] <= 0.5
    assert report["aruco_error_mean_deg"] <= 0.3
    assert report["dice"]["mean"] > 0.9
    assert report["per_object"]["bar"]["hard"] == "heavy"
    assert all(7.0 <= abs(rotation) <= 17.5 for rotation in report["per_object"]["bar"]["turns_deg"])
    page = (experiment / "report.html").read_text()
    assert "simulated; not comparable" in page
    assert "data:image/png;base64," in page
    assert "http" not in page.replace("http-equiv", "")
    assert (experiment / "errors.png").stat().st_size > 5000


@pytest.mark.campaign
def test_recorded_lifts_are_not_repeated(experiment: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recordings = sorted((experiment / "lifts").glob("*.mcap"))
    before = [path.stat().st_mtime_ns for path in recordings]
    recordings[1].with_suffix(".json").write_text("{")
    protocol = str(experiment.parent / "p.toml")
    assert run(["evaluate", "run", "--sim", "--protocol", protocol, "--out", str(experiment), "--jobs", "1"]) == 0
    assert [path.stat().st_mtime_ns for path in recordings] == before
    assert run(["evaluate", "report", str(experiment), "--jobs", "1", "--json"]) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["lifts"] == 2


def test_an_unknown_object_and_a_missing_camera_are_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "p.toml").write_text('objects = [{name = "mug"}]\n')
    protocol = str(tmp_path / "p.toml")
    assert run(["evaluate", "run", "--sim", "--protocol", protocol, "--out", str(tmp_path / "o")]) == 2
    assert "no simulated object 'mug'" in capsys.readouterr().err
    assert run(["evaluate", "run", "--protocol", protocol, "--out", str(tmp_path / "o")]) == 2
    assert "a real cell needs --config, --protocol and --intrinsics" in capsys.readouterr().err
