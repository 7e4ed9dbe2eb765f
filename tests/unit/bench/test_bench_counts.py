"""The frames that the bench counts: for errors, for overlaps, and the skipped frames of a minute of holding."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from slipguard.bench.holding import HoldingResult
from slipguard.bench.pipeline_results import GraspErrors, PipelineResults
from slipguard.bench.pipelines import BenchPipeline, with_small_network
from slipguard.bench.run import _row
from slipguard.datasets.rendered_grasps import GraspFrame
from slipguard.devices import Frame
from slipguard.perception.estimate import Estimate

PAPER_PATH = Path(__file__).resolve().parents[3] / "models" / "deeplabv3plus-resnet18.onnx"


class FixedProcessor:
    """A processor that finds the labeled mask and reports every frame as skipped for this reason."""

    def __init__(self, mask: NDArray[np.uint8], skipped: str | None) -> None:
        self.last_mask, self._skipped = mask, skipped

    def process(self, frame: Frame) -> Estimate:
        contact = self._skipped is None
        estimate = Estimate(frame.sequence, 0.0, 0.0, contact, 900, "registration", declined="fixed")
        return replace(estimate, skipped=self._skipped)


def test_a_contact_skipped_as_no_contact_has_no_overlap() -> None:
    mask = np.zeros((320, 240), np.uint8)
    mask[100:200, 50:150] = 1
    shot = GraspFrame(Frame(np.zeros((320, 240, 3), np.uint8), 0.0, 0), True, 0.0, True, mask)
    for skipped, label, overlaps in (
        (None, mask, [(1.0, 1.0)]),
        ("no contact", mask, [(0.0, 0.0)]),
        ("no contact", np.zeros_like(mask), []),  # touched too lightly for a label
        ("unchanged", mask, []),
    ):
        results = PipelineResults()
        results.take(FixedProcessor(mask, skipped), replace(shot, mask=label), GraspErrors("bar", True, 0.0))
        assert results.overlaps == overlaps


def test_errors_exclude_declined_frames_and_objects_outside_the_manifest() -> None:
    found: list[tuple[float, float, float | None]] = [(1.0, 1.0, 1.0)] * 4
    results = PipelineResults(grasps=[GraspErrors("bar", True, 0.0, 6, found), GraspErrors("ring", False, 0.0, 9),
                          GraspErrors("plain_disc", False, 0.0, 5, found)])  # fmt: skip
    row = results.row(with_small_network(None, all_without_skipping=False)[0], results, 1.0, 3.6)
    assert (row.frames, row.sequences, row.turns, row.turn_sequences) == (20, 3, 4, 1)


def test_the_minute_of_a_large_network_is_computed_with_the_skipped_frames() -> None:
    like = HoldingResult(frames=100, wall_s=0.1, measured_s=0.08, skipped={"unchanged": 70, "no contact": 10})
    assert (like.mean_ms, like.measured_ms) == pytest.approx((1.0, 4.0))
    large = BenchPipeline("ours", "large", "registration", PAPER_PATH, "frame")
    tallies = {large.name: PipelineResults(busy_ms=[18.0, 18.0])}
    row = _row(large, tallies, tallies, {}, like)
    assert row.mean_ms_per_frame_grasp == pytest.approx(1.0 + 0.2 * (18.0 - 4.0))
    assert row.cpu_s_per_minute_grasp == pytest.approx(3.6 * 3.8)
