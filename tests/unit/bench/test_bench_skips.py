"""What skips are worth is measured as it says: on a crop, on a second finger, on an unchanged picture."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from slipguard.bench import holding, skip_values
from slipguard.bench.holding import HoldingScene, hold
from slipguard.bench.pipelines import NO_SKIP, BenchPipeline, ours
from slipguard.bench.segmentation_cache import CLOCK, CachedSegmenter
from slipguard.bench.slip_onset import SlipOnset
from slipguard.control.slip_baselines import SlipMemory
from slipguard.datasets.rendered_grasps import render_grasp
from slipguard.devices import Frame
from slipguard.perception.contact.segmenter import Segmenter
from slipguard.perception.skipping import ALL_SKIPS, Skips


def default() -> BenchPipeline:
    return next(one for one in ours(None, every=False) if one.estimator == "fused" and one.skips != NO_SKIP)


@dataclass
class Blind:
    """A law that never sees a slip."""

    detector: SlipMemory
    slipping: bool = False


def test_how_much_later_a_slip_is_seen_is_measured_for_the_gate_too(monkeypatch: pytest.MonkeyPatch) -> None:
    answers = iter((9, 7, 9, None, None, 3))
    asked: list[Skips] = []

    def first_seen(process: Any, frames: list[Frame]) -> int | None:
        asked.append(process.__self__._skips)
        return next(answers)

    monkeypatch.setattr(skip_values, "first_seen", first_seen)
    tried = skip_values._OnsetTrial(SlipOnset("key", 7000, 60.0), default())
    assert skip_values._later(tried) == skip_values._OnsetDelay(no_contact=2, unchanged=0)
    assert asked == [ALL_SKIPS, Skips(no_contact=False), Skips(unchanged=False)]
    later = skip_values._later(tried)
    assert later.no_contact is None
    assert later.unchanged is not None
    assert later.unchanged > 90
    worth = skip_values._no_contact(default(), 1, [None, later.unchanged, 0])
    assert worth.frames_later == later.unchanged
    assert worth.how.endswith("2 slips after rest (1 that nobody sees aside)")
    assert skip_values._most([None]) is None


@pytest.mark.extras("onnx")
def test_a_spared_finger_is_cheaper_and_no_slip_is_overlooked(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(holding, "LIFTED_S", 1.0)
    monkeypatch.setattr(holding, "MINUTE_S", 4.0)
    monkeypatch.setattr(holding, "_ROTATIONS", ((3.0, 3.4, 8.0, 0.1),))
    worth = skip_values.second_finger(default())
    assert worth.frames_later is not None
    assert worth.frames_later <= 1
    monkeypatch.setattr(skip_values, "look", lambda detector, fused, law: Blind(detector))
    assert skip_values.second_finger(default()).frames_later is None
    assert not worth.how.startswith("0 of")
    assert abs(worth.error_added_deg or 0.0) < 0.3


@pytest.mark.realtime
def test_a_minute_is_held_with_most_frames_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(holding, "LIFTED_S", 1.0)
    monkeypatch.setattr(holding, "MINUTE_S", 4.0)
    monkeypatch.setattr(holding, "_ROTATIONS", ())
    held = hold([default()], HoldingScene())[default().name]
    assert held.frames == 240
    assert held.skipped["unchanged"] > 60
    assert 0.0 < held.mean_ms < held.measured_ms
    assert np.mean(held.errors_deg) < 0.5


@pytest.mark.realtime
def test_remembered_answers_cost_what_they_cost() -> None:
    network = CachedSegmenter(Segmenter())
    image = render_grasp("bar", 2).shots[20].frame.image
    network.memory.forget(on=True)
    began_s = CLOCK()
    first = network.segment(image, None)
    once_s = CLOCK() - began_s
    assert network.segment(image, None) is first
    assert CLOCK() - began_s > 1.8 * once_s
    network.memory.forget(on=False)
    assert network.segment(image, None) is not network.segment(image, None)
