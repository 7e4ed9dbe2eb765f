"""models/README.md describes the shipped network correctly."""

import hashlib
import re

from slipguard.perception.segmenter import Segmenter, default_model_path

LARGEST_BYTES = 1_500_000


def test_the_card_lists_the_shipped_file() -> None:
    path = default_model_path()
    data = path.read_bytes()
    card = (path.parent / "README.md").read_text()
    row = re.search(rf"`{path.name}` .*\| (\d+) kB \| `([0-9a-f]{{64}})`", card)
    assert row is not None
    assert row[2] == hashlib.sha256(data).hexdigest()
    assert int(row[1]) == round(len(data) / 1000)
    assert len(data) <= LARGEST_BYTES


def test_the_card_contains_the_training_command() -> None:
    segmenter = Segmenter()
    card = (segmenter.path.parent / "README.md").read_text()
    assert segmenter.metadata["command"] in card
