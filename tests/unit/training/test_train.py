"""Training resumes after an interruption, and its export fulfills the model contract."""

import importlib.util
from pathlib import Path

import cv2
import numpy as np
import pytest
from command_line import slipguard

from slipguard.cli.train import train as train_command
from slipguard.errors import InputError
from slipguard.perception.segmenter import Segmenter
from slipguard.tools.parallel import Workers

needs_torch = pytest.mark.extras("torch", "onnx")


def test_without_torch_the_error_says_how_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"pip install 'slipguard\[train\]'") as caught:
        train_command()
    assert "\n" not in str(caught.value)


@needs_torch
def test_a_stopped_training_resumes_and_its_export_fulfills_the_contract(tmp_path: Path) -> None:
    import torch

    from slipguard.training.augment import TrainingFrames
    from slipguard.training.onnx_export import export_small, model_metadata
    from slipguard.training.small_network import SmallNet
    from slipguard.training.train import EpochFigures, TrainSettings, train

    rng = np.random.default_rng(0)
    background = rng.integers(40, 90, (8, 160, 120, 3), np.uint8)
    label = np.zeros((8, 160, 120), np.uint8)
    label[:, 40:90, 30:80] = 255
    frames = TrainingFrames(background + (label[..., None] // 5), background, np.ones(8, np.float32), label)
    settings = TrainSettings(epochs=3, batch=4, threads=1, patterns=6)

    class Stopped(Exception):
        pass

    def stop(figures: EpochFigures, net: SmallNet) -> None:
        if figures.epoch == 2:
            raise Stopped

    def nothing(*_: object) -> None:
        return

    whole, parts = tmp_path / "whole", tmp_path / "parts"
    whole.mkdir()
    parts.mkdir()
    at_once = train(frames, frames, settings, whole, nothing, nothing)
    assert (whole / "weights.pt").is_file()
    with pytest.raises(Stopped):
        train(frames, frames, settings, parts, nothing, stop)
    epochs: list[int] = []
    resumed = train(frames, frames, settings, parts, nothing, lambda figures, net: epochs.append(figures.epoch))
    assert epochs == [2, 3]
    for one, other in zip(at_once.state_dict().values(), resumed.state_dict().values(), strict=True):
        torch.testing.assert_close(one, other)

    path = tmp_path / "small.onnx"
    assert export_small(resumed, path, model_metadata("slipguard train", 0, 0.4), frames) <= 1e-4
    assert Segmenter(path).threshold == 0.4
    weights = sum(part.numel() for part in resumed.parameters())
    assert path.stat().st_size < 3 * weights, "large weights take two bytes in the file"
    assert not list(tmp_path.glob("*.draft.onnx"))


@needs_torch
def test_the_command_trains_on_a_data_set(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    data = tmp_path / "discs"
    for kind in ("images", "masks"):
        (data / kind).mkdir(parents=True)
    for index in range(6):
        mask = np.zeros((320, 240), np.uint8)
        cv2.circle(mask, (60 + 20 * index, 160), 50, (255,), -1)
        cv2.imwrite(str(data / "images" / f"{index}.png"), np.dstack([mask // 2 + np.uint8(40)] * 3))
        cv2.imwrite(str(data / "masks" / f"{index}.png"), mask)
    path = tmp_path / "net.onnx"
    line = f"train --data {data} --validate {data} --out {path} --work {tmp_path} --epochs 1 --batch 4 --threads 1"
    ran = slipguard(capfd, *line.split())
    assert ran.code == 0, ran.err
    assert "epoch 1:" in ran.out
    segmenter = Segmenter(path)
    assert segmenter.metadata["label"] == "imported"
    assert segmenter.metadata["command"].startswith("slipguard train --data (5 frames)")
    assert "no data set" in slipguard(capfd, "train", "--data", tmp_path / "nowhere").complaint


@needs_torch
def test_rendered_frames_are_those_of_their_seeds() -> None:
    from slipguard.datasets.samples import UNIT_FRAMES, render_samples
    from slipguard.training.augment import TrainingFrames

    ready: list[int] = []
    first = UNIT_FRAMES - 2
    frames = TrainingFrames.rendered(first, 4, ready.append, Workers(jobs=1))
    assert ready == [1, 2, 3, 4]
    shown = cv2.resize(
        next(render_samples(range(first + 2, first + 3))).image, (120, 160), interpolation=cv2.INTER_AREA
    )
    np.testing.assert_array_equal(frames.frame[2], shown)
    assert frames.known.all()
    training, held_out = frames.split()
    assert (len(training), len(held_out)) == (3, 1)


@needs_torch
@pytest.mark.parametrize("spoil", ["missing", "shape", "unknown", "no weights", "no file"])
def test_weights_of_another_network_are_refused(tmp_path: Path, spoil: str) -> None:
    import torch

    from slipguard.training.small_network import SmallNet
    from slipguard.training.train import load_weights

    path = tmp_path / "weights.pt"
    weights = SmallNet().state_dict()
    torch.save(weights, path)
    load_weights(SmallNet(), path)
    name = sorted(key for key, value in weights.items() if value.ndim == 4)[0]
    if spoil == "missing":
        del weights[name]
    elif spoil == "shape":
        weights[name] = weights[name][:1]
    elif spoil == "unknown":
        weights["old.weight"] = torch.zeros(3)
    torch.save(weights, path)
    if spoil == "no weights":
        path.write_bytes(b"text")
    elif spoil == "no file":
        path.unlink()
    with pytest.raises(InputError, match="not the weights of this network") as caught:
        load_weights(SmallNet(), path)
    assert "\n" not in str(caught.value)
