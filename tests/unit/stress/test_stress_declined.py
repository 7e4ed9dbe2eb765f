"""Stress trials that say nothing, or that something drifts in, are no success; what they hold is what they say."""

from __future__ import annotations

import io
import itertools
from collections import Counter
from dataclasses import replace
from typing import Any

import pytest
from rich.console import Console

from slipguard.devices import Frame
from slipguard.perception.estimate import AxisEstimate, Estimate
from slipguard.perception.pipeline import Pipeline
from slipguard.perception.rotation import rotation_meter as rotations
from slipguard.perception.rotation.contour_registration import ContourFit, ContourPose, ContourRegistrar
from slipguard.perception.rotation.tracker import RotationEstimate, RotationTracker
from slipguard.stress import drift_families, runner
from slipguard.stress.drift_families import DRIFT, HOLDING, OBJECTS
from slipguard.stress.product_functions import ProductFunctions
from slipguard.stress.report import as_json, first_failures, print_table
from slipguard.stress.runner import FAMILIES, JUDGED_FROM, StressOutcome, chosen, run


class Mute:
    """A pipeline that declines every frame."""

    has_reference = False

    def __init__(self, *_: object) -> None:
        pass

    def process(self, frame: Frame) -> Estimate:
        return Estimate(frame.sequence, frame.captured_at_s, frame.captured_at_s, True, 4000, "fused", declined="mute")


class MuteTracker(RotationTracker):
    def accept(self, now_s: float, rotation: RotationEstimate) -> RotationEstimate:
        return RotationEstimate(None, None, "mute")


def mute() -> ProductFunctions:
    return ProductFunctions(
        pipeline=Mute, tracker=MuteTracker, estimate=lambda patch, name: AxisEstimate(name, None, None, None, "mute"),
        fuse=lambda left, right: None,
    )  # fmt: skip


def tried(only: str, trials: int, product: ProductFunctions | None = None, seed: int = 0) -> StressOutcome:
    ticks = itertools.count()
    return run(chosen([only]), seed, float(trials), product, clock=lambda: float(next(ticks)))


def trials_until_judged(name: str) -> int:
    return -(-JUDGED_FROM // chosen([name])[0].frames) + 1


@pytest.mark.parametrize("family", [family.name for family in FAMILIES])
def test_a_family_that_tells_nothing_fails(family: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runner, "JUDGED_FROM", 8)
    outcome = tried(family, 10, mute()) if family != "drift" else tried(family, 1, mute())
    assert outcome.failed
    (silent,) = outcome.rarely_answering
    assert (silent.family, silent.kind) == (family, "limit")
    assert silent in first_failures(outcome)
    assert as_json(outcome)["broken_promises"] >= 1
    shown = io.StringIO()
    print_table(Console(file=shown, width=120), outcome)
    assert "is promised" in shown.getvalue()


@pytest.mark.parametrize("family", ["equivariance", "noise", "seams", "round", "floats", "times"])
def test_a_pipeline_that_tells_nothing_fails_though_the_estimators_speak(family: str) -> None:
    outcome = tried(family, trials_until_judged(family), ProductFunctions(pipeline=Mute))
    assert outcome.rarely_answering


@pytest.mark.parametrize("family", [family.name for family in FAMILIES if family.cost_ms < 60.0])
def test_what_there_is_tells_enough(family: str) -> None:
    outcome = tried(family, trials_until_judged(family), seed=4000)
    assert not outcome.rarely_answering, outcome.rarely_answering
    assert not outcome.failed, first_failures(outcome)


def test_a_family_is_not_judged_before_enough_is_tried() -> None:
    outcome = tried("seams", 5, mute())
    assert not outcome.rarely_answering
    assert (
        replace(chosen(["seams"])[0], min_answered_share=0.0).min_answered_share
        < chosen(["seams"])[0].min_answered_share
    )


def test_a_registration_that_goes_on_from_where_it_was_wrong_is_caught(monkeypatch: pytest.MonkeyPatch) -> None:
    class Dragged(ContourRegistrar):
        def fit(self, start: ContourPose) -> ContourFit:
            found = super().fit(start)
            drawn = 0.5 * (found.pose.rotation_deg + start.rotation_deg) + 0.15
            return replace(found, pose=replace(found.pose, rotation_deg=drawn))

    assert tried("drift", 2).results[0].promises[DRIFT] < 0.05
    monkeypatch.setattr(rotations, "Registrar", Dragged)
    assert tried("drift", 2).results[0].counts["limit"] > 0


def test_a_pipeline_that_drifts_while_it_holds_is_caught(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(drift_families, "CYCLE_FRAMES", 60)
    monkeypatch.setattr(drift_families, "MOVING_FRAMES", 15)

    class Drifting(Pipeline):
        def process(self, frame: Frame) -> Estimate:
            answer = super().process(frame)
            off = 4e-3 * frame.sequence
            return answer if answer.angle_deg is None else replace(answer, angle_deg=answer.angle_deg + off)

    two_cycles = 2 * 60 // drift_families.TRIAL_FRAMES * len(OBJECTS) + 2
    assert tried("holding", two_cycles).results[0].promises[HOLDING] < 0.05
    assert tried("holding", two_cycles, ProductFunctions(pipeline=Drifting)).results[0].counts["limit"] > 0


def test_what_is_held_has_a_relief_takes_keys_and_leaves_frames_out() -> None:
    seen: dict[int, Counter[str]] = {}

    class Watched(Pipeline):
        def process(self, frame: Frame) -> Estimate:
            answer = super().process(frame)
            reference: Any = self._meter.reference
            relief = None if reference is None else reference.relief
            counts = seen.setdefault(id(self), Counter())
            counts.update(
                unchanged=answer.skipped == "unchanged",
                relief=relief is not None,
                key=relief is not None and relief._key is not None,
            )
            return answer

    outcome = tried("holding", 300 // drift_families.TRIAL_FRAMES * len(OBJECTS), ProductFunctions(pipeline=Watched))
    assert len(seen) == len(OBJECTS)
    assert all(counts["unchanged"] > 100 and counts["relief"] > 250 and counts["key"] > 200 for counts in seen.values())
    assert outcome.results[0].worst_deg["coin"] < 1.5
