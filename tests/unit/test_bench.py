"""The bench's parts that need no minute: sequences, the peer's file, the report of given figures."""

from __future__ import annotations

import json
from io import StringIO
from pathlib import Path
from typing import cast

import numpy as np
import pytest
from rich.console import Console

from slipguard.errors import ModelError
from slipguard.lab import bench_report
from slipguard.lab.bench import Bench, Row
from slipguard.lab.peer import Peer
from slipguard.lab.sequences import EMPTY_FRAMES, TURN_DEG, sequence

KEYS = [
    "name", "network", "estimator", "p50_ms", "p99_ms", "skipped_p50_ms", "turn_error_mean_deg",
    "turn_error_worst_object_deg", "declined_share", "dice", "iou", "frames", "sequences",
]  # fmt: skip


def found() -> Bench:
    ours = Row("net + fused", "net", "fused", 3.0, 5.0, 0.3, 0.6, 1.2, 0.05, 0.95, 0.9, 700, 10)
    peer = Row("paper", "peer", "skeleton", 150.0, 160.0, None, None, None, None, None, None, 24, None)
    return Bench({"processor": "test"}, (ours,), (peer,), "net + fused", {})


def test_the_json_has_the_public_keys_in_order() -> None:
    result = json.loads(json.dumps(found().as_json()))
    assert list(result) == ["machine", "pipelines", "peers", "default"]
    assert list(result["pipelines"][0]) == list(result["peers"][0]) == KEYS
    assert result["peers"][0]["turn_error_mean_deg"] is None
    assert result["default"] == result["pipelines"][0]["name"]


def test_the_table_tells_the_ratio_to_the_peer_and_the_picture_is_drawn(tmp_path: Path) -> None:
    console = Console(width=140, file=StringIO())
    console.print(bench_report.table(found()), *bench_report.notes(found()))
    text = cast("StringIO", console.file).getvalue()
    assert "50" in text
    assert "default" in text
    bench_report.picture(found(), tmp_path / "bench.png")
    assert (tmp_path / "bench.png").stat().st_size > 5_000


def test_a_sequence_is_repeatable_and_its_truth_begins_at_nothing() -> None:
    one, again = sequence("battery", 3, with_masks=True), sequence("battery", 3)
    assert [s.turn_deg for s in one.shots] == [s.turn_deg for s in again.shots]
    np.testing.assert_array_equal(one.shots[20].frame.image, again.shots[20].frame.image)
    assert not any(s.contact for s in one.shots[:EMPTY_FRAMES])
    compared = [s for s in one.shots if s.compared]
    assert abs(compared[0].turn_deg) < 6.0
    turns = [s.turn_deg for s in compared]
    assert TURN_DEG[0] <= abs(turns[-1]) <= TURN_DEG[1]
    assert min(turns) * max(turns) < 0.0
    assert max(map(abs, turns)) <= TURN_DEG[1]
    assert 1.0 <= one.growth < 2.0
    assert one.peak_deg_s > 0.0
    assert all(s.mask is not None for s in one.shots)
    assert one.shots[20].mask is not None
    assert one.shots[20].mask.any()
    assert not np.array_equal(one.shots[20].frame.image, sequence("battery", 4).shots[20].frame.image)


def test_the_peer_runs_on_dense_weights() -> None:
    image = np.random.default_rng(0).integers(0, 255, (320, 240, 3)).astype(np.uint8)
    mask = np.zeros((320, 240), np.uint8)
    mask[60:260, 80:120] = 1
    skeleton = Peer().run(image, mask)
    assert 100 < np.count_nonzero(skeleton) < 400


def test_a_missing_peer_says_how_to_make_it(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match=r"slipguard\.lab\.peer"):
        Peer(tmp_path / "none.onnx")
