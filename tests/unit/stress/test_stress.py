"""The stress trials detect estimators that are wrong, return NaN or crash, and print how to reproduce it."""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from sampled import sampled

from slipguard.cli.app import run as cli
from slipguard.control.finger_fusion import FusedEstimate, fuse
from slipguard.devices import Frame
from slipguard.errors import InputError
from slipguard.perception.axis import estimate_axis
from slipguard.perception.estimate import AxisEstimate, Estimate, RotationEstimate
from slipguard.perception.patch import Patch
from slipguard.perception.pipeline import Pipeline
from slipguard.perception.rotation_filter import Hypothesis, RotationFilter
from slipguard.stress.masks import degenerate_masks
from slipguard.stress.product_functions import ProductFunctions
from slipguard.stress.report import as_json, first_failures
from slipguard.stress.runner import FAMILIES, StressOutcome, run, schedule, select_families
from slipguard.stress.trial_family import FamilyResults, TrialFamily

FLAWS = ("biased", "nan", "raising")
SEED = {"degenerate": 55, "times": 0}
"""Seeds at which the list reaches a bar, and a trial of the pipeline."""
TRIALS = {"degenerate": 3}
KIND = {"biased": "confident wrong", "nan": "nan", "raising": "crash"}


def run_trials(only: str, trials: int, product: ProductFunctions | None = None, seed: int = 0) -> StressOutcome:
    """Run this many trials of one family; the clock advances by one per trial."""
    ticks = itertools.count()
    return run(select_families([only]), seed, float(trials), product, clock=lambda: float(next(ticks)))


def faulty(flaw: str, angle_deg: float | None) -> tuple[float | None, float | None]:
    """Return a faulty angle and sigma."""
    if flaw == "raising":
        raise ValueError("broken on purpose")
    if angle_deg is None:
        return None, None
    return (math.nan, 1.0) if flaw == "nan" else (0.5 * angle_deg + 20.0, 0.05)


def faulty_estimate(flaw: str) -> Callable[[Patch, str], AxisEstimate]:
    def broken(patch: Patch, name: str) -> AxisEstimate:
        found = estimate_axis(patch, name)
        angle, sigma = faulty(flaw, found.angle_deg)
        return replace(found, angle_deg=angle, sigma_deg=sigma)

    return broken


class FaultyPipeline(Pipeline):
    flaw = "biased"

    def process(self, frame: Frame) -> Estimate:
        answer = super().process(frame)
        angle, sigma = faulty(self.flaw, answer.rotation_deg)
        return replace(answer, rotation_deg=angle, sigma_deg=sigma)


def faulty_pipeline(flaw: str) -> type[Pipeline]:
    return type("Faulty", (FaultyPipeline,), {"flaw": flaw})


class FaultyFilter(RotationFilter):
    flaw = "biased"

    def update(self, now_s: float, found: Sequence[Hypothesis]) -> RotationEstimate:
        rotation_deg, _ = faulty(self.flaw, super().update(now_s, found).rotation_deg)
        return RotationEstimate(rotation_deg, None)


def faulty_filter(flaw: str) -> type[RotationFilter]:
    return type("Faulty", (FaultyFilter,), {"flaw": flaw})


def faulty_fuse(flaw: str) -> Callable[[Estimate | None, Estimate | None], FusedEstimate | None]:
    def broken(left: Estimate | None, right: Estimate | None) -> FusedEstimate | None:
        fused = fuse(left, right)
        if fused is None:
            return None
        angle, sigma = faulty(flaw, fused.rotation_deg)
        return replace(fused, rotation_deg=angle, sigma_deg=sigma)

    return broken


@pytest.mark.parametrize("flaw", sampled(FLAWS))
def test_a_faulty_estimator_is_detected(flaw: str) -> None:
    outcome = run_trials("axes", 3, ProductFunctions(estimate=faulty_estimate(flaw)))
    assert outcome.results[0].counts[KIND[flaw]] > 0
    assert outcome.failed


@pytest.mark.parametrize("flaw", sampled(FLAWS))
@pytest.mark.parametrize("family", ["degenerate", "axes", "floats", "holding", "pictures", "relief", "times"])
def test_a_faulty_pipeline_is_detected(family: str, flaw: str) -> None:
    product = ProductFunctions(pipeline=faulty_pipeline(flaw))
    outcome = run_trials(family, TRIALS.get(family, 4), product, SEED.get(family, 3))
    assert outcome.results[0].counts[KIND[flaw]] > 0


@pytest.mark.parametrize("flaw", FLAWS)
def test_a_faulty_filter_is_detected(flaw: str) -> None:
    product = ProductFunctions(rotations=faulty_filter(flaw))
    assert run_trials("times", 3, product, seed=1).results[0].counts[KIND[flaw]] > 0


@pytest.mark.campaign
def test_a_drift_of_a_tenth_of_a_degree_is_detected() -> None:
    class Drifting(Pipeline):
        def process(self, frame: Frame) -> Estimate:
            answer = super().process(frame)
            off = 2e-3 * frame.sequence
            return answer if answer.rotation_deg is None else replace(answer, rotation_deg=answer.rotation_deg + off)

    outcome = run_trials("drift", 1, ProductFunctions(pipeline=Drifting))
    assert outcome.results[0].counts["limit"] > 0
    assert as_json(outcome)["drift_deg"] > 0.1


@pytest.mark.parametrize("flaw", FLAWS)
def test_a_faulty_fusion_is_detected(flaw: str) -> None:
    assert run_trials("fusion", 40, ProductFunctions(fuse=faulty_fuse(flaw))).results[0].counts[KIND[flaw]] > 0


def test_a_mask_that_is_not_thinned_is_detected() -> None:
    def unthinned(mask: NDArray[np.uint8]) -> NDArray[np.uint8]:
        return mask

    outcome = run_trials("degenerate", 3, ProductFunctions(thin=unthinned), SEED["degenerate"])
    assert outcome.results[0].counts["limit"] > 0


def test_the_seed_of_a_failure_reproduces_it() -> None:
    product = ProductFunctions(estimate=faulty_estimate("biased"))
    first = first_failures(run_trials("axes", 4, product, seed=100))[0]
    assert first_failures(run_trials("axes", 1, product, seed=first.seed))[0] == first


@pytest.fixture(scope="module")
def quick() -> StressOutcome:
    return run(FAMILIES, 0, 0.2)


@pytest.mark.campaign
def test_a_quick_run_tries_every_family_without_failure(quick: StressOutcome) -> None:
    assert all(results.tried > 0 for results in quick.results)
    assert not quick.failed, [one.what for one in first_failures(quick)]
    found = as_json(quick)
    assert (found["crashes"], found["nan"], found["confident_wrong"], found["broken_promises"]) == (0, 0, 0, 0)
    assert found["tried"] == sum(results.tried for results in quick.results)
    assert 0.0 < found["share"] < 0.01
    assert set(found["worst"]) == {family.name for family in FAMILIES}
    assert found["drift_deg"] <= 0.1


def test_equal_seeds_give_equal_results() -> None:
    def without_time(outcome: StressOutcome) -> dict[str, Any]:
        return {key: value for key, value in as_json(outcome).items() if key != "spent_s"}

    for name in ("axes", "times"):
        assert without_time(run_trials(name, 6, seed=5)) == without_time(run_trials(name, 6, seed=5))
        assert without_time(run_trials(name, 6, seed=5)) != without_time(run_trials(name, 6, seed=6))


def test_families_alternate_in_a_fixed_order_until_the_list_ends() -> None:
    def family(name: str, full: int, cost_ms: float) -> TrialFamily:
        return TrialFamily(name, "", full, cost_ms, lambda product: lambda rng, seed, results: None)

    slow, quick_one = family("slow", 3, 10.0), family("quick", 40, 1.0)
    order = [index for index, _ in schedule((slow, quick_one))]
    assert order.count(0) == 3
    assert order.count(1) == 40
    assert 8 <= order[: order.index(0) + 1].count(1) <= 10
    outcome = run((slow, quick_one), 0, math.inf)
    assert [results.tried for results in outcome.results] == [3, 40]
    assert as_json(outcome)["share"] == 1.0


def test_an_error_counts_as_confidently_wrong_above_its_sigmas() -> None:
    def counted(angle: float | None, sigma: float | None, truth: float | None, *, axial: bool = False) -> int:
        results = FamilyResults("test")
        results.check_angle("x", angle, sigma, truth, axial=axial)
        return results.counts.total()

    assert counted(10.0, 1.0, 0.0) == 1
    assert counted(10.0, 2.1, 0.0) == 0
    assert counted(2.9, 0.1, 0.0) == 0
    assert counted(178.0, 0.1, 0.0, axial=True) == 0
    assert counted(10.0, 3.0, None) == 1
    assert counted(10.0, 3.4, None) == 0
    assert counted(None, None, 0.0) == 0
    assert counted(math.nan, 1.0, 0.0) == 1
    assert counted(0.0, 0.0, 0.0) == 1
    assert counted(0.0, None, 0.0) == 1


def test_degenerate_masks_are_valid() -> None:
    import cv2

    masks = degenerate_masks()
    assert masks["empty"].sum() == 0
    assert masks["full"].all()
    assert cv2.connectedComponents(masks["10,000 components"])[0] - 1 >= 10_000
    assert all(mask.dtype == np.uint8 and mask.max() <= 1 for mask in masks.values())


def test_the_command_prints_json_and_writes_the_plot(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "stress"
    assert cli(["stress", "--only", "axes", "--only", "fusion", "--seconds", "0.1", "--json", "--out", str(out)]) == 0
    found = json.loads(capsys.readouterr().out)
    assert set(found) == {"tried", "share", "crashes", "nan", "confident_wrong", "worst", "drift_deg", "broken_at"}
    assert found["drift_deg"] is None
    assert (out / "error-against-noise.png").stat().st_size > 10_000
    written = json.loads((out / "stress.json").read_text())
    assert {key: written[key] for key in found} == found
    assert written["full_hours"] > 0.0


def test_the_command_prints_a_table(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli(["stress", "--only", "axes", "--seconds", "0.01"]) == 0
    shown = capsys.readouterr().out
    assert "axes" in shown
    assert "of the full list" in " ".join(shown.split())


def test_a_failure_gives_exit_code_1(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr("slipguard.stress.runner.ProductFunctions", lambda: ProductFunctions(fuse=faulty_fuse("nan")))
    assert cli(["stress", "--only", "fusion", "--seconds", "0.05"]) == 1
    assert "reproduce: slipguard stress --only fusion --seed" in " ".join(capsys.readouterr().out.split())


def test_an_unknown_family_is_refused_with_the_known_ones(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(InputError, match="degenerate, axes, floats"):
        select_families(["nonsense"])
    assert cli(["stress", "--only", "nonsense"]) == 2
    assert "Choose from degenerate" in capsys.readouterr().err
