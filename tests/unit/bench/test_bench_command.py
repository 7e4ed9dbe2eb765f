"""`slipguard bench` from the command line to its table, JSON and plot, on short grasps of a single object."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from slipguard.bench import pipelines, scenes
from slipguard.bench import run as bench
from slipguard.cli.app import run
from slipguard.datasets.rendered_grasps import RenderedGrasp, render_grasp
from slipguard.tools.parallel import Workers

MODELS = Path(__file__).resolve().parents[3] / "models"
NAME = "deeplabv3plus-resnet18.onnx"
pytestmark = pytest.mark.campaign


def short_grasp(*args: Any, **kwargs: Any) -> RenderedGrasp:
    """Two empty frames, the frames around the first rotation, and the last one; masks stay on every fourth frame."""
    grasp = render_grasp(*args, **kwargs)
    start = next(index for index, shot in enumerate(grasp.shots) if shot.compared) - 8
    start -= (start - 2) % 4
    return replace(grasp, shots=grasp.shots[:2] + grasp.shots[start : start + 22] + grasp.shots[-1:])


@pytest.fixture(autouse=True)
def _short_grasps_of_one_object(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench, "object_names", lambda split: ("bar",))
    monkeypatch.setattr(bench, "EXTRA_PLAIN", ())
    monkeypatch.setattr(scenes, "WARM_UP_FRAMES", 5)
    monkeypatch.setattr(bench, "EFFECTS", ("rocking",))
    monkeypatch.setattr(bench, "QUICK_EFFECT_CASES", 1)
    monkeypatch.setattr(bench, "FULL_EFFECT_SEEDS", 1)
    monkeypatch.setattr(bench, "effect_cases", lambda effect: ("bar",))
    monkeypatch.setattr(scenes, "render_grasp", short_grasp)
    monkeypatch.setattr(scenes, "HOLD_S", 3.0)


def test_large_networks_process_the_same_grasps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pipelines, "ESTIMATORS", ("registration", "moments"))
    monkeypatch.setattr(bench, "FULL_GRASPS", 2)
    (tmp_path / NAME).symlink_to(MODELS / NAME)
    found = bench.bench(bench.BenchOptions(quick=False, models=tmp_path, workers=Workers(jobs=1)))
    known = [row for row in (*found.pipelines, *found.peers) if row.turn_error_mean_deg is not None]
    assert {row.network for row in known} >= {"tsnn-small", "deeplabv3plus-resnet18", "background subtraction"}
    assert {row.sequences for row in known} == {2}
    assert all(row.p50_ms is not None for row in (*found.pipelines, *found.peers))
    assert found.reference("120×160") is not None
    timed_only = found.reference("240×320")
    assert timed_only is not None
    assert timed_only.turn_error_mean_deg is None


def test_a_quick_bench_with_further_networks(tmp_path: Path) -> None:
    (tmp_path / NAME).symlink_to(MODELS / NAME)
    found = bench.bench(bench.BenchOptions(models=tmp_path))
    assert not [row for row in found.pipelines if row.network == "deeplabv3plus-resnet18"]
    assert {row.resolution for row in found.peers} == {"120×160", "240×320"}


def test_the_command_writes_json_and_plot(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert run(["bench", "--quick", "--json", "--out", str(tmp_path)]) == 0
    found = json.loads(capfd.readouterr().out)
    assert found == json.loads((tmp_path / "bench.json").read_text())
    assert (tmp_path / "bench.png").stat().st_size > 5000
    assert [skip["name"].split(":")[0] for skip in found["skips"]] == ["no contact", "unchanged", "moves as a whole"]
