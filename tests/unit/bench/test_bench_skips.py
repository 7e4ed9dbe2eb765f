"""The value of skips: frames without contact, unchanged frames, and the second finger."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from slipguard.bench import holding, skip_values
from slipguard.bench.holding import HoldingScene, measure_holding
from slipguard.bench.pipelines import NO_SKIP, BenchPipeline, with_small_network
from slipguard.bench.slip_onset import SlipOnset
from slipguard.devices import Frame
from slipguard.perception.skipping import ALL_SKIPS, Skips


def default() -> BenchPipeline:
    return next(
        one
        for one in with_small_network(None, all_without_skipping=False)
        if one.estimator == "registration" and one.skips != NO_SKIP
    )


def test_the_detection_delay_is_measured_for_both_skips(monkeypatch: pytest.MonkeyPatch) -> None:
    detections = iter((9, 7, 9, None, None, 3))
    requested: list[Skips] = []

    def first_detection(process: Any, frames: list[Frame]) -> int | None:
        requested.append(process.__self__._skips)
        return next(detections)

    monkeypatch.setattr(skip_values, "first_detection", first_detection)
    assert skip_values._delays(default(), SlipOnset("key", 7000, 60.0)) == (2, 0)
    assert requested == [ALL_SKIPS, Skips(no_contact=False), Skips(unchanged=False)]
    no_contact, unchanged = skip_values._delays(default(), SlipOnset("key", 7000, 60.0))
    assert no_contact is None
    assert unchanged is not None
    assert unchanged > 90
    worth = skip_values._no_contact(default(), 1, [None, unchanged, 0])
    assert worth.frames_later == unchanged
    assert worth.how.endswith("2 slips after rest detected, 1 not detected without skipping either")
    assert skip_values._longest([None]) is None


@pytest.mark.extras("onnx")
def test_skipping_the_second_finger_misses_no_slip(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(holding, "LIFTED_S", 1.0)
    monkeypatch.setattr(holding, "MINUTE_S", 4.0)
    monkeypatch.setattr(holding, "ROTATIONS", ((3.0, 3.4, 8.0, 0.1),))
    worth = skip_values.measure_second_finger(default())
    assert worth.frames_later is not None
    assert worth.frames_later <= 1
    monkeypatch.setattr(skip_values.SlipWatch, "slips", lambda self, fused: False)
    assert skip_values.measure_second_finger(default()).frames_later is None
    assert not worth.how.startswith("0 of")
    assert abs(worth.error_added_deg or 0.0) < 0.3


@pytest.mark.realtime
def test_most_frames_of_a_minute_of_holding_are_skipped(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(holding, "LIFTED_S", 1.0)
    monkeypatch.setattr(holding, "MINUTE_S", 4.0)
    monkeypatch.setattr(holding, "ROTATIONS", ())
    held = measure_holding([default()], HoldingScene())[default().name]
    assert held.frames == 240
    assert held.skipped["unchanged"] > 60
    assert 0.0 < held.mean_ms < held.measured_ms
    assert np.mean(held.errors_deg) < 0.5
