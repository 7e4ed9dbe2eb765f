"""`slipguard bench` from the command line to its table, JSON and plot, on short grasps of a single object."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import pytest

from slipguard.bench import effects, pipelines, skip_values
from slipguard.bench import run as bench
from slipguard.bench.holding import HoldingScene
from slipguard.cli.app import run
from slipguard.datasets.rendered_grasps import RenderedGrasp, render_grasp
from slipguard.tools.parallel import Workers

MODELS = Path(__file__).resolve().parents[3] / "models"
NAME = "deeplabv3plus-resnet18.onnx"


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
    monkeypatch.setattr(bench, "LARGE_FRAMES_QUICK", 2)
    monkeypatch.setattr(bench, "WARM_UP_FRAMES", 5)
    monkeypatch.setattr(effects, "EFFECTS", ("rocking",))
    monkeypatch.setattr(effects, "QUICK_CASES", 1)
    monkeypatch.setattr(effects, "FULL_SEEDS", 1)
    monkeypatch.setattr(effects, "effect_cases", lambda effect: ("bar",))
    monkeypatch.setattr(bench, "render_grasp", short_grasp)
    monkeypatch.setattr(skip_values, "render_grasp", short_grasp)
    monkeypatch.setattr(skip_values, "QUICK_ONSETS", skip_values.QUICK_ONSETS[:1])
    whole = HoldingScene.shots
    monkeypatch.setattr(HoldingScene, "shots", lambda self: islice(whole(self), 150))


@pytest.mark.campaign
def test_large_networks_process_the_same_grasps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pipelines, "ESTIMATORS", ("registration", "moments"))
    monkeypatch.setattr(bench, "FULL_GRASPS", 2)
    monkeypatch.setattr(bench, "measure_skips", lambda *_: ())
    monkeypatch.setattr(bench, "compare_thinning", lambda *_, **__: ())
    (tmp_path / NAME).symlink_to(MODELS / NAME)
    found = bench.bench(bench.BenchOptions(quick=False, models=tmp_path, workers=Workers(jobs=1)))
    known = [row for row in (*found.pipelines, *found.peers) if row.turn_error_mean_deg is not None]
    assert {row.network for row in known} >= {"tsnn-small", "deeplabv3plus-resnet18", "background subtraction"}
    assert {row.sequences for row in known} == {2}
    assert len({row.frames for row in known if row.network != "background subtraction"}) == 1
    assert found.reference("120×160") is not None
    timed_only = found.reference("240×320")
    assert timed_only is not None
    assert timed_only.turn_error_mean_deg is None


@pytest.mark.campaign
def test_a_quick_bench_with_further_networks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench, "measure_skips", lambda *_: ())
    monkeypatch.setattr(bench, "compare_thinning", lambda *_, **__: ())
    (tmp_path / NAME).symlink_to(MODELS / NAME)
    found = bench.bench(bench.BenchOptions(models=tmp_path))
    assert not [row for row in found.pipelines if row.network == "deeplabv3plus-resnet18"]
    assert {row.resolution for row in found.peers} == {"120×160", "240×320"}


@pytest.mark.campaign
def test_the_command_writes_json_and_plot(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert run(["bench", "--quick", "--json", "--out", str(tmp_path)]) == 0
    found = json.loads(capfd.readouterr().out)
    assert found == json.loads((tmp_path / "bench.json").read_text())
    assert (tmp_path / "bench.png").stat().st_size > 5000
