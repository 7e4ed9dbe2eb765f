"""Stress trials fail if estimates are declined too often or drift; the held objects exercise texture and skipping."""

from __future__ import annotations

import io
import itertools
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import pytest
from rich.console import Console

from slipguard.devices import Frame
from slipguard.perception.estimate import AxisEstimate, Estimate, RotationEstimate
from slipguard.perception.pipeline import Pipeline
from slipguard.perception.rotation_filter import Hypothesis, RotationFilter
from slipguard.stress import drift_families, runner
from slipguard.stress.drift_families import HOLDING, OBJECTS
from slipguard.stress.product_functions import ProductFunctions
from slipguard.stress.report import as_json, first_failures, print_table
from slipguard.stress.runner import FAMILIES, MIN_JUDGED_TRIALS, StressOutcome, run, select_families

pytestmark = pytest.mark.campaign


class DecliningPipeline:
    """A pipeline that declines every frame."""

    has_reference = False

    def __init__(self, *_: object, **__: object) -> None:
        pass

    def process(self, frame: Frame) -> Estimate:
        return Estimate(
            frame.sequence, frame.captured_at_s, frame.captured_at_s, True, 4000, "model", declined="always declined"
        )


class DecliningFilter(RotationFilter):
    def update(self, now_s: float, found: Sequence[Hypothesis]) -> RotationEstimate:
        return RotationEstimate(None, None, "always declined")


def declining() -> ProductFunctions:
    return ProductFunctions(
        pipeline=DecliningPipeline, rotations=DecliningFilter,
        estimate=lambda patch, name: AxisEstimate(name, None, None, None, "always declined"),
        fuse=lambda left, right: None,
    )  # fmt: skip


def run_trials(only: str, trials: int, product: ProductFunctions | None = None, seed: int = 0) -> StressOutcome:
    ticks = itertools.count()
    return run(select_families([only]), seed, float(trials), product, clock=lambda: float(next(ticks)))


def trials_until_checked(name: str) -> int:
    return -(-MIN_JUDGED_TRIALS // select_families([name])[0].frames) + 1


@pytest.mark.parametrize("family", [family.name for family in FAMILIES])
def test_a_family_fails_if_every_estimate_is_declined(family: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runner, "MIN_JUDGED_TRIALS", 8)
    outcome = run_trials(family, 1 if family in ("drift", "effects") else 10, declining())
    assert outcome.failed
    (failure,) = outcome.rarely_answering
    assert (failure.family, failure.kind) == (family, "limit")
    assert failure in first_failures(outcome)
    assert as_json(outcome)["broken_promises"] >= 1
    shown = io.StringIO()
    print_table(Console(file=shown, width=120), outcome)
    assert "the minimum is" in shown.getvalue()


@pytest.mark.parametrize("family", ["axes", "floats"])
def test_a_declining_pipeline_fails_although_the_axis_estimators_work(family: str) -> None:
    outcome = run_trials(family, trials_until_checked(family), ProductFunctions(pipeline=DecliningPipeline))
    assert outcome.rarely_answering


@pytest.mark.parametrize("family", [family.name for family in FAMILIES if family.cost_ms < 100.0])
def test_the_product_declines_rarely_enough(family: str) -> None:
    outcome = run_trials(family, trials_until_checked(family), seed=4000)
    assert not outcome.rarely_answering, outcome.rarely_answering
    assert not outcome.failed, first_failures(outcome)


def test_the_share_of_estimates_is_not_checked_after_few_trials() -> None:
    outcome = run_trials("axes", 5, declining())
    assert not outcome.rarely_answering
    assert (
        replace(select_families(["axes"])[0], min_answered_share=0.0).min_answered_share
        < select_families(["axes"])[0].min_answered_share
    )


def test_a_pipeline_that_drifts_while_holding_is_detected(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(drift_families, "CYCLE_FRAMES", 40)
    monkeypatch.setattr(drift_families, "MOVING_FRAMES", 10)

    class Drifting(Pipeline):
        def process(self, frame: Frame) -> Estimate:
            answer = super().process(frame)
            off = 4e-3 * frame.sequence
            return answer if answer.rotation_deg is None else replace(answer, rotation_deg=answer.rotation_deg + off)

    two_cycles = 2 * 40 // drift_families.TRIAL_FRAMES * len(OBJECTS) + 2
    assert run_trials("holding", two_cycles).results[0].largest[HOLDING] < 0.05
    assert run_trials("holding", two_cycles, ProductFunctions(pipeline=Drifting)).results[0].counts["limit"] > 0


def test_held_objects_are_registered_and_skip_frames() -> None:
    seen: dict[int, Counter[str]] = {}

    class Watched(Pipeline):
        def process(self, frame: Frame) -> Estimate:
            answer = super().process(frame)
            counts = seen.setdefault(id(self), Counter())
            counts.update(unchanged=answer.skipped == "unchanged", measured=answer.rotation_deg is not None)
            return answer

    outcome = run_trials(
        "holding", 300 // drift_families.TRIAL_FRAMES * len(OBJECTS), ProductFunctions(pipeline=Watched)
    )
    assert len(seen) == len(OBJECTS)
    assert all(counts["unchanged"] > 100 and counts["measured"] > 250 for counts in seen.values())
    assert outcome.results[0].worst_deg["coin"] < 1.5
