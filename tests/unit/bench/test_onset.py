"""No slip is seen more than one frame later because frames were left out, quick or slow, turning or sliding."""

from __future__ import annotations

from functools import cache

import pytest

from slipguard.bench.slip_onset import SlipOnset, first_seen, later_by
from slipguard.datasets.rendered_grasps import RenderedGrasp
from slipguard.devices import Frame
from slipguard.perception.contact.segmenter import Segmenter
from slipguard.perception.estimate import Estimate
from slipguard.perception.pipeline import Pipeline
from slipguard.perception.settings import PerceptionSettings
from slipguard.perception.skipping import ALL_SKIPS, Skips


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
        SlipOnset("ring", 7104, 5.0, slides=True),
        SlipOnset("screwdriver", 7105, 3.0, slides=True),
    ],
    ids=lambda onset: f"{onset.object_name} {onset.rate:g}",
)
def test_a_slip_after_rest_is_seen_no_more_than_one_frame_later(onset: SlipOnset) -> None:
    grasp = onset.grasp()
    frames = [shot.frame for shot in grasp.shots]
    reused = 0

    def counted(frame: Frame) -> Estimate:
        nonlocal reused
        answer = skipping.process(frame)
        reused += answer.skipped == "unchanged"
        return answer

    skipping = pipeline(grasp, ALL_SKIPS)
    measuring = pipeline(grasp, Skips(unchanged=False))
    later = later_by(first_seen(counted, frames), first_seen(measuring.process, frames), len(frames))
    assert later is not None
    assert later <= 1
    assert reused > 20  # or nothing was tried


def test_what_is_overlooked_counts_as_seen_after_the_end() -> None:
    grasp = SlipOnset("key", 7106, 40.0).grasp()
    frames = [shot.frame for shot in grasp.shots]
    measuring = pipeline(grasp, Skips(unchanged=False))
    answers = {frame.sequence: measuring.process(frame) for frame in frames}
    seen = first_seen(lambda frame: answers[frame.sequence], frames)
    assert seen is not None
    stuck = answers[frames[60].sequence]
    assert first_seen(lambda _frame: stuck, frames) is None
    assert later_by(None, seen, len(frames)) == len(frames) - seen
    assert later_by(seen, None, len(frames)) is None
