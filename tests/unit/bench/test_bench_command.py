"""`slipguard bench` from the command line to its table, JSON and picture, on a single object."""

from __future__ import annotations

import json
from itertools import islice
from pathlib import Path

import pytest

from slipguard.bench import pipelines as subjects
from slipguard.bench import run as bench
from slipguard.bench import skip_values
from slipguard.bench.holding import HoldingScene
from slipguard.cli.app import run
from slipguard.tools.parallel import Workers

MODELS = Path(__file__).resolve().parents[3] / "models"
NAME = "deeplabv3plus-resnet18.onnx"


@pytest.fixture(autouse=True)
def _one_object(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench, "names", lambda split: ("bar",))
    monkeypatch.setattr(bench, "EXTRA_PLAIN", ())
    monkeypatch.setattr(bench, "LARGE_FRAMES_QUICK", 2)
    monkeypatch.setattr(skip_values, "QUICK_ONSETS", skip_values.QUICK_ONSETS[:1])
    whole = HoldingScene.shots
    monkeypatch.setattr(HoldingScene, "shots", lambda self: islice(whole(self), 240))


def test_large_networks_are_asked_of_the_same_grasps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(subjects, "ESTIMATORS", ("fused", "moments"))
    monkeypatch.setattr(bench, "FULL_GRASPS", 2)
    monkeypatch.setattr(bench, "skips", lambda *_: ())
    monkeypatch.setattr(bench, "thinning", lambda *_, **__: ())
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


def test_a_quick_one_with_further_networks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench, "skips", lambda *_: ())
    monkeypatch.setattr(bench, "thinning", lambda *_, **__: ())
    (tmp_path / NAME).symlink_to(MODELS / NAME)
    found = bench.bench(bench.BenchOptions(models=tmp_path))
    assert not [row for row in found.pipelines if row.network == "deeplabv3plus-resnet18"]
    assert {row.resolution for row in found.peers} == {"120×160", "240×320"}


def test_a_short_one(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert run(["bench", "--quick", "--json", "--out", str(tmp_path)]) == 0
    found = json.loads(capfd.readouterr().out)
    assert found == json.loads((tmp_path / "bench.json").read_text())
    assert (tmp_path / "bench.png").stat().st_size > 5000
