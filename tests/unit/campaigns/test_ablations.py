"""The comparison of variants runs from frames to table, and scores what it says it scores."""

from pathlib import Path

import numpy as np
import pytest

pytestmark = pytest.mark.extras("torch", "onnx")


def test_variants_are_trained_measured_and_tabled(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from slipguard.training.train import TrainSettings
    from tests.campaigns import ablations
    from tests.campaigns.ablation_frames import CONTACT

    short = TrainSettings(epochs=1, batch=8, patterns=6, threads=1)
    variants = (
        ablations.Variant("as shipped", settings=short),
        ablations.Variant(
            "small", mask=CONTACT, inputs="change", size=(96, 128), widths=(8, 16, 32, 0), settings=short
        ),
        ablations.Variant("frame alone", inputs="frame", widths=(8, 16, 32, 0), settings=short),
    )
    monkeypatch.setattr(ablations, "VARIANTS", variants)
    monkeypatch.setattr(ablations, "HELD_OUT_FRAMES", 8)
    monkeypatch.setattr(ablations, "TIMED_ROUNDS", 3)
    ablations.compare_variants(tmp_path, None, None, 16, 1, 1, False)
    first = capsys.readouterr().out
    rows = [line.split("|")[1:-1] for line in first.splitlines() if line.startswith("| ")]
    assert [row[0].strip().split(" (")[0] for row in rows] == [
        "variant",
        "as shipped",
        "small",
        "frame alone",
        "int8, otherwise as shipped",
        "crop around the known patch",
    ]
    assert all(0.0 <= float(row[2]) <= 1.0 for row in rows[1:])
    weights = {path: path.stat().st_mtime_ns for path in tmp_path.glob("*/weights.pt")}
    ablations.compare_variants(tmp_path, None, None, 16, 1, 1, False)
    assert weights == {path: path.stat().st_mtime_ns for path in tmp_path.glob("*/weights.pt")}, "trained again"
    assert len(weights) == 3


def test_held_out_objects_are_in_no_training_frame(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from slipguard.sim.catalogue import object_names
    from tests.campaigns import ablation_frames

    assert set(ablation_frames.HELD_OUT) <= set(object_names("train"))
    seen: list[str] = []
    original = ablation_frames.render_sample

    def noted(seed: int) -> object:
        drawn = original(seed)
        seen.append(drawn.view.object_name)
        return drawn

    monkeypatch.setattr(ablation_frames, "render_sample", noted)
    drawn = ablation_frames.training_frames(tmp_path, 12, lambda _done: None)
    assert len(drawn) == 12
    assert len([name for name in seen if name not in ablation_frames.HELD_OUT]) >= 12
    share = drawn.masks(0.15).mean(), drawn.masks(0.3).mean()
    assert share[0] > share[1] > 0.0
    small = drawn.at((120, 160), drawn.masks(0.15))
    assert small.frame.shape == (12, 160, 120, 3)
    assert np.abs(small.label.mean() / 255.0 - share[0]) < 0.01
