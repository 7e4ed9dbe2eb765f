"""models/README.md describes the paper's network correctly."""

import hashlib
import re
from pathlib import Path

from slipguard.perception.segmenter import Segmenter

MODELS = Path(__file__).resolve().parents[3] / "models"
NAME = "deeplabv3plus-resnet18.onnx"
LARGEST_BYTES = 26_000_000


def test_the_card_lists_the_papers_network_and_its_command() -> None:
    data = (MODELS / NAME).read_bytes()
    card = (MODELS / "README.md").read_text()
    row = re.search(rf"`{NAME}` .*\| ([0-9.]+) MB \| `([0-9a-f]{{64}})`", card)
    assert row is not None
    assert row[2] == hashlib.sha256(data).hexdigest()
    assert float(row[1]) == round(len(data) / 1e6, 1)
    assert len(data) <= LARGEST_BYTES
    segmenter = Segmenter(MODELS / NAME)
    assert segmenter.metadata["command"] in card


def test_every_model_is_listed_with_its_checksum() -> None:
    card = (MODELS / "README.md").read_text()
    listed = dict(re.findall(r"^\| `([^`]+\.onnx)` \|.*\| `([0-9a-f]{64})` \|$", card, re.MULTILINE))
    for name in ("tsnn-small.onnx", NAME, "peer-deeplabv3plus-resnet18-timing.onnx"):
        assert listed.pop(name) == hashlib.sha256((MODELS / name).read_bytes()).hexdigest()
    assert not listed


def test_the_papers_network_is_not_in_the_wheel() -> None:
    assert f'"models/{NAME}" =' not in (MODELS.parent / "pyproject.toml").read_text()
