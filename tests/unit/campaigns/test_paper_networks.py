"""The paper's networks are built, trained briefly, resumed, exported and run by the product."""

from __future__ import annotations

import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from command_line import slipguard

from slipguard.errors import InputError, ModelError
from slipguard.perception.segmenter import Segmenter
from tests.campaigns.command_line import run

pytestmark = pytest.mark.extras("torch", "onnx", "segmentation_models_pytorch")


@pytest.fixture(scope="module")
def data_set(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a data set of seven frames with a bright disc as contact."""
    folder = tmp_path_factory.mktemp("discs")
    rng = np.random.default_rng(0)
    for kind in ("images", "masks"):
        (folder / kind).mkdir()
    for index in range(7):
        mask = np.zeros((320, 240), np.uint8)
        cv2.circle(mask, (int(rng.integers(60, 180)), int(rng.integers(60, 260))), 50, (255,), -1)
        image = rng.integers(30, 60, (320, 240, 3)).astype(np.uint8) + (mask // 2)[..., None]
        cv2.imwrite(str(folder / "images" / f"{index}.png"), image)
        cv2.imwrite(str(folder / "masks" / f"{index}.png"), mask)
    return folder


@pytest.fixture(scope="module")
def trained(data_set: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a trained PSPNet, net.onnx."""
    folder = tmp_path_factory.mktemp("trained")
    assert run([*words(data_set, folder), "--out", str(folder / "net.onnx")]) == 0
    return folder


def words(data: Path, work: Path, epochs: int = 2) -> list[str]:
    line = f"--recipe short --epochs {epochs} --batch 3 --threads 1 --data {data} --work {work}"
    return ["train-paper-network", "pspnet", *line.split()]


def test_the_command_writes_the_history(trained: Path) -> None:
    work = trained / "pspnet-short"
    measured = json.loads((work / "history.json").read_text())
    assert [epoch["number"] for epoch in measured["epochs"]] == [1, 2]
    assert all(0.0 <= epoch["iou"] <= epoch["dice"] <= 1.0 for epoch in measured["epochs"])
    assert measured["settings"]["encoder"] == "random"


def test_the_product_runs_the_file(trained: Path) -> None:
    segmenter = Segmenter(trained / "net.onnx")
    assert segmenter.input_size == (120, 160)
    assert segmenter.metadata["slipguard_contract"] == "2"
    assert segmenter.metadata["label"] == "imported"
    assert " train-paper-network pspnet --recipe short --epochs 2" in segmenter.metadata["command"]
    image = np.random.default_rng(0).integers(0, 256, (320, 240, 3)).astype(np.uint8)
    estimate = segmenter.segment(image, None)
    assert estimate.shape == (160, 120)
    assert np.array_equal(estimate, segmenter.segment(image, image))


def test_large_weights_are_stored_as_float16(trained: Path) -> None:
    import onnx

    weights = onnx.load(str(trained / "net.onnx")).graph.initializer
    large = {array.data_type for array in weights if np.prod(array.dims) > 2000}
    assert large == {onnx.TensorProto.FLOAT16}


def test_a_stopped_training_resumes(
    data_set: Path, trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    from tests.campaigns.paper_networks import training

    keep = training._save_checkpoint

    def keep_and_stop(*what: object) -> None:
        keep(*what)  # type: ignore[arg-type]
        raise KeyboardInterrupt

    monkeypatch.setattr(training, "_save_checkpoint", keep_and_stop)
    again = [*words(data_set, tmp_path), "--out", str(tmp_path / "net.onnx")]
    assert slipguard(capfd, *again, run=run).code == 1
    assert not (tmp_path / "net.onnx").exists()
    monkeypatch.setattr(training, "_save_checkpoint", keep)
    resumed = slipguard(capfd, *again, run=run)
    assert resumed.code == 0, resumed.err
    assert "epoch 2:" in resumed.out
    assert "epoch 1:" not in resumed.out
    one, two = (Segmenter(folder / "net.onnx") for folder in (trained, tmp_path))
    image = np.full((320, 240, 3), 90, np.uint8)
    np.testing.assert_allclose(one.segment(image, None), two.segment(image, None), atol=1e-3)
    other = slipguard(capfd, *words(data_set, tmp_path, epochs=5), "--out", str(tmp_path / "net.onnx"), run=run)
    assert "holds a training with" in other.complaint


def test_averages_over_unequal_cells_equal_those_of_torch() -> None:
    import torch

    from tests.campaigns.paper_networks.networks import _cell_means

    x = torch.rand(2, 3, 20, 15)
    for cells in (1, 2, 3, 6):
        down, across = (torch.from_numpy(_cell_means(side, cells)) for side in (20, 15))
        wanted = torch.nn.functional.adaptive_avg_pool2d(x, cells)
        assert torch.allclose(down @ x @ across.T, wanted, atol=1e-6)


@pytest.mark.parametrize("arch", ["deeplabv3plus", "unetplusplus"])
@pytest.mark.parametrize(("height", "width"), [(160, 120), (320, 240)])
def test_the_larger_networks_return_masks_of_frame_size(arch: str, height: int, width: int) -> None:
    import torch

    from tests.campaigns.paper_networks.networks import FrameNet
    from tests.campaigns.paper_networks.recipe import Arch

    net = FrameNet(Arch(arch), height, width).eval()
    with torch.no_grad():
        assert net(torch.zeros(1, height, width, 3, dtype=torch.uint8)).shape == (1, 1, height, width)


@pytest.mark.parametrize(("weight", "allowed"), [(None, -1.0), (math.nan, 1.0)])
def test_an_export_that_differs_or_is_not_finite_is_not_written(
    weight: float | None, allowed: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from slipguard.training import onnx_export
    from tests.campaigns.paper_networks.networks import FrameNet, export_paper
    from tests.campaigns.paper_networks.recipe import Arch

    frames = np.zeros((1, 160, 120, 3), np.uint8)
    monkeypatch.setattr(onnx_export, "DIFFERENCE_MAX", allowed)
    (tmp_path / "net.onnx").write_text("as it was")
    net = FrameNet(Arch.pspnet, 160, 120)
    if weight is not None:
        next(net.parameters()).data.fill_(weight)
    with pytest.raises(ModelError, match="not written"):
        export_paper(net, tmp_path / "net.onnx", {}, frames)
    assert (tmp_path / "net.onnx").read_text() == "as it was"
    assert [path.name for path in tmp_path.iterdir()] == ["net.onnx"]


def test_an_encoder_starts_from_given_weights(tmp_path: Path) -> None:
    import torch

    from tests.campaigns.paper_networks.networks import FrameNet
    from tests.campaigns.paper_networks.recipe import Arch

    source, target = FrameNet(Arch.pspnet, 160, 120), FrameNet(Arch.pspnet, 160, 120)
    state = source.net.encoder.state_dict() | {"fc.weight": torch.zeros(1), "fc.bias": torch.zeros(1)}
    torch.save(state, tmp_path / "resnet18.pth")
    target.start_encoder_from(tmp_path / "resnet18.pth")
    assert torch.equal(target.net.encoder.conv1.weight, source.net.encoder.conv1.weight)
    assert not torch.equal(target.net.decoder.conv[0].weight, source.net.decoder.conv[0].weight)
    torch.save(source.state_dict(), tmp_path / "weights.pt")
    target.start_from(tmp_path / "weights.pt")
    assert torch.equal(target.net.decoder.conv[0].weight, source.net.decoder.conv[0].weight)
    (tmp_path / "wrong.pth").write_text("no weights")
    for wrong, said in (("wrong.pth", "not the weights"), ("nowhere.pth", "cannot be read")):
        with pytest.raises(InputError, match=said):
            target.start_encoder_from(tmp_path / wrong)
        with pytest.raises(InputError, match=said):
            target.start_from(tmp_path / wrong)


def test_focal_loss_is_cross_entropy_for_uncertain_pixels() -> None:
    import torch

    from tests.campaigns.paper_networks.training import focal_loss

    uncertain = focal_loss(torch.zeros(4), torch.tensor([0.0, 1.0, 0.0, 1.0]))
    assert float(uncertain) == pytest.approx(0.25 * np.log(2.0), rel=1e-5)
    certain = focal_loss(torch.tensor([6.0]), torch.tensor([1.0]))
    assert float(certain) < 1e-4 * float(uncertain)


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("pspnet --data nowhere", "no data set"),
        ("pspnet --encoder-weights nowhere.pth", "cannot be read"),
    ],
)
def test_misuse_is_one_line(tmp_path: Path, capfd: pytest.CaptureFixture[str], line: str, said: str) -> None:
    ran = slipguard(capfd, "train-paper-network", *line.split(), "--work", tmp_path, run=run)
    assert ran.code == 2
    assert said in ran.complaint


def test_the_comparison_table_scores_a_network(trained: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from slipguard.perception.segmenter import Segmenter
    from tests.campaigns import network_table

    rng = np.random.default_rng(1)
    image = rng.integers(0, 256, (320, 240, 3)).astype(np.uint8)
    mask = np.zeros((320, 240), np.bool_)
    frames = [network_table.LabeledFrame(image, image, mask), network_table.LabeledFrame(image, image, ~mask)]
    (row,) = network_table.compare_networks([("net", Segmenter(trained / "net.onnx"))], frames)
    assert (row.name, row.frames, row.untouched) == ("net", 1, 1)
    assert 0.0 <= row.iou[0] <= row.dice[0] <= 1.0
    assert run(["network-table", str(trained / "nowhere.onnx"), "--grasps", "1"]) == 2
    assert capsys.readouterr().err.startswith("slipguard: ")
