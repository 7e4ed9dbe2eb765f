"""Skipping frames delays the detection of a slip by at most one frame."""

from __future__ import annotations

from functools import cache

import pytest
from slip_onset import SlipOnset, detection_delay, first_detection

from slipguard.datasets.rendered_grasps import RenderedGrasp
from slipguard.devices import Frame
from slipguard.perception.estimate import Estimate
from slipguard.perception.pipeline import Pipeline
from slipguard.perception.segmenter import Segmenter
from slipguard.perception.settings import PerceptionSettings
from slipguard.perception.skipping import ALL_SKIPS, Skips

pytestmark = pytest.mark.campaign


@cache
def segmenter() -> Segmenter:
    return Segmenter()


def pipeline(grasp: RenderedGrasp, skips: Skips) -> Pipeline:
    return Pipeline(segmenter(), PerceptionSettings(), grasp.background, grasp.noise_bgr, grasp.px_per_mm, skips=skips)


@pytest.mark.parametrize(
    "onset",
    [
        SlipOnset("key", 7100, 3.0),
        SlipOnset("wrench", 7101, 8.0),
        SlipOnset("bar", 7102, 60.0),
        SlipOnset("knife_edge", 7103, 300.0),
        SlipOnset("ring", 7104, 5.0, translates=True),
        SlipOnset("screwdriver", 7105, 3.0, translates=True),
    ],
    ids=lambda onset: f"{onset.object_name} {onset.rate:g}",
)
def test_a_slip_after_rest_is_detected_at_most_one_frame_later(onset: SlipOnset) -> None:
    grasp = onset.grasp()
    frames = [shot.frame for shot in grasp.shots]
    reused = 0

    def counted(frame: Frame) -> Estimate:
        nonlocal reused
        estimate = skipping.process(frame)
        reused += estimate.skipped == "unchanged"
        return estimate

    skipping = pipeline(grasp, ALL_SKIPS)
    measuring = pipeline(grasp, Skips(unchanged=False, whole=False))
    delay = detection_delay(first_detection(counted, frames), first_detection(measuring.process, frames), len(frames))
    assert delay is not None
    assert delay <= 1
    assert reused > 20  # otherwise nothing is tested


def test_a_missed_slip_counts_as_detected_after_the_last_frame() -> None:
    grasp = SlipOnset("key", 7106, 40.0).grasp()
    frames = [shot.frame for shot in grasp.shots]
    measuring = pipeline(grasp, Skips(unchanged=False))
    estimates = {frame.sequence: measuring.process(frame) for frame in frames}
    detected = first_detection(lambda frame: estimates[frame.sequence], frames)
    assert detected is not None
    stuck = estimates[frames[60].sequence]
    assert first_detection(lambda _frame: stuck, frames) is None
    assert detection_delay(None, detected, len(frames)) == len(frames) - detected
    assert detection_delay(detected, None, len(frames)) is None
