"""The stress trials catch estimators that are wrong, give NaN or crash, and say how to see it again."""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from slipguard.cli.app import run as cli
from slipguard.control.finger_fusion import FusedEstimate, fuse
from slipguard.devices import Frame
from slipguard.errors import InputError
from slipguard.perception.contact.patch import Patch
from slipguard.perception.estimate import AxisEstimate, Estimate
from slipguard.perception.pipeline import Pipeline
from slipguard.perception.rotation.axis import estimate
from slipguard.perception.rotation.tracker import RotationEstimate, RotationTracker
from slipguard.stress.masks import degenerate, rotated, rotated_axis_deg
from slipguard.stress.numeric_families import fitted_ellipse_deg, second_moments_deg
from slipguard.stress.product_functions import ProductFunctions
from slipguard.stress.report import as_json, first_failures
from slipguard.stress.runner import FAMILIES, StressOutcome, chosen, parts, run, run_whole, schedule
from slipguard.stress.shapes import ELONGATED, ShapePose, soft
from slipguard.stress.trial_family import KEPT_FAILURES, FamilyResults, TrialFamily
from slipguard.tools.parallel import Workers

FLAWS = ("biased", "nan", "raising")
SEED = {"degenerate": 55, "times": 0}
"""Where the list comes to a bar, and to a trial of the pipeline."""
KIND = {"biased": "confident wrong", "nan": "nan", "raising": "crash"}


def tried(only: str, trials: int, product: ProductFunctions | None = None, seed: int = 0) -> StressOutcome:
    """So many trials of one family: the clock ticks once a trial."""
    ticks = itertools.count()
    return run(chosen([only]), seed, float(trials), product, clock=lambda: float(next(ticks)))


def spoiled(flaw: str, angle_deg: float | None) -> tuple[float | None, float | None]:
    """An angle and its sigma, spoiled."""
    if flaw == "raising":
        raise ValueError("broken on purpose")
    if angle_deg is None:
        return None, None
    return (math.nan, 1.0) if flaw == "nan" else (0.5 * angle_deg + 20.0, 0.05)


def broken_estimate(flaw: str) -> Callable[[Patch, str], AxisEstimate]:
    def broken(patch: Patch, name: str) -> AxisEstimate:
        found = estimate(patch, name)
        angle, sigma = spoiled(flaw, found.angle_deg)
        return replace(found, angle_deg=angle, sigma_deg=sigma)

    return broken


class BrokenPipeline(Pipeline):
    flaw = "biased"

    def process(self, frame: Frame) -> Estimate:
        answer = super().process(frame)
        angle, sigma = spoiled(self.flaw, answer.angle_deg)
        return replace(answer, angle_deg=angle, sigma_deg=sigma)


def broken_pipeline(flaw: str) -> type[Pipeline]:
    return type("Broken", (BrokenPipeline,), {"flaw": flaw})


class BrokenTracker(RotationTracker):
    flaw = "biased"

    def accept(self, now_s: float, rotation: RotationEstimate) -> RotationEstimate:
        accepted = super().accept(now_s, rotation)
        return RotationEstimate(*spoiled(self.flaw, accepted.rotation_deg))


def broken_tracker(flaw: str) -> type[RotationTracker]:
    return type("Broken", (BrokenTracker,), {"flaw": flaw})


def broken_fuse(flaw: str) -> Callable[[Estimate | None, Estimate | None], FusedEstimate | None]:
    def broken(left: Estimate | None, right: Estimate | None) -> FusedEstimate | None:
        fused = fuse(left, right)
        if fused is None:
            return None
        angle, sigma = spoiled(flaw, fused.rotation_deg)
        return replace(fused, rotation_deg=angle, sigma_deg=sigma)

    return broken


@pytest.mark.parametrize("flaw", FLAWS)
@pytest.mark.parametrize("family", ["degenerate", "random", "equivariance", "noise", "seams", "round", "floats"])
def test_a_broken_estimator_is_caught(family: str, flaw: str) -> None:
    trials = {"random": 60, "round": 25, "degenerate": 10}.get(family, 5)
    outcome = tried(family, trials, ProductFunctions(estimate=broken_estimate(flaw)), SEED.get(family, 3))
    # Both readings of a clean and a poisoned map are wrong by the same: only the comparison with float64 tells.
    kind = "limit" if (family, flaw) == ("floats", "biased") else KIND[flaw]
    assert outcome.results[0].counts[kind] > 0
    assert outcome.failed


@pytest.mark.parametrize("flaw", FLAWS)
@pytest.mark.parametrize(
    "family", ["degenerate", "equivariance", "noise", "seams", "round", "floats", "holding", "pictures", "times"]
)
def test_a_broken_pipeline_is_caught(family: str, flaw: str) -> None:
    trials = {"round": 25, "degenerate": 10}.get(family, 4)
    outcome = tried(family, trials, ProductFunctions(pipeline=broken_pipeline(flaw)), SEED.get(family, 3))
    assert outcome.results[0].counts[KIND[flaw]] > 0


@pytest.mark.parametrize("flaw", FLAWS)
def test_a_broken_tracker_is_caught(flaw: str) -> None:
    product = ProductFunctions(tracker=broken_tracker(flaw))
    assert tried("times", 3, product, seed=1).results[0].counts[KIND[flaw]] > 0
    assert tried("drift", 2, product).failed


def test_a_drift_of_a_tenth_of_a_degree_is_caught() -> None:
    class Drifting(RotationTracker):
        off = 0.0

        def accept(self, now_s: float, rotation: RotationEstimate) -> RotationEstimate:
            accepted = super().accept(now_s, rotation)
            self.off += 1e-4
            return replace(accepted, rotation_deg=(accepted.rotation_deg or 0.0) + self.off)

    outcome = tried("drift", 4, ProductFunctions(tracker=Drifting))
    assert outcome.results[0].counts["limit"] > 0
    assert as_json(outcome)["drift_deg"] > 0.1


@pytest.mark.parametrize("flaw", FLAWS)
def test_a_broken_fusion_is_caught(flaw: str) -> None:
    assert tried("fusion", 40, ProductFunctions(fuse=broken_fuse(flaw))).results[0].counts[KIND[flaw]] > 0


@pytest.mark.parametrize("family", ["degenerate", "random"])
def test_one_pixel_too_many_in_a_thinned_mask_is_caught(family: str) -> None:
    def unthinned(mask: NDArray[np.uint8]) -> NDArray[np.uint8]:
        return mask

    assert tried(family, 40, ProductFunctions(thin=unthinned)).results[0].counts["limit"] > 0


def test_a_failure_is_shown_again_by_its_seed() -> None:
    product = ProductFunctions(estimate=broken_estimate("biased"))
    first = first_failures(tried("noise", 4, product, seed=100))[0]
    assert first_failures(tried("noise", 1, product, seed=first.seed))[0] == first


@pytest.fixture(scope="module")
def quick() -> StressOutcome:
    return run(FAMILIES, 0, 0.2)


def test_a_quick_run_tries_every_family_and_finds_nothing_wrong(quick: StressOutcome) -> None:
    assert all(results.tried > 0 for results in quick.results)
    assert not quick.failed, [one.what for one in first_failures(quick)]
    found = as_json(quick)
    assert (found["crashes"], found["nan"], found["confident_wrong"], found["broken_promises"]) == (0, 0, 0, 0)
    assert found["tried"] == sum(results.tried for results in quick.results)
    assert 0.0 < found["share"] < 0.01
    assert set(found["worst"]) == {family.name for family in FAMILIES}
    assert found["drift_deg"] <= 0.1


def test_a_ring_cut_by_the_frame_does_not_turn_by_and_by() -> None:
    results = tried("round", 1, seed=9028).results[0]
    assert not results.failures, results.failures


def test_the_same_seed_finds_the_same() -> None:
    def without_time(outcome: StressOutcome) -> dict[str, Any]:
        return {key: value for key, value in as_json(outcome).items() if key != "spent_s"}

    for name in ("round", "random", "times"):
        assert without_time(tried(name, 6, seed=5)) == without_time(tried(name, 6, seed=5))
        assert without_time(tried(name, 6, seed=5)) != without_time(tried(name, 6, seed=6))


def test_families_take_turns_in_a_fixed_order_and_the_list_ends() -> None:
    def family(name: str, full: int, cost_ms: float) -> TrialFamily:
        return TrialFamily(name, "", full, cost_ms, lambda product: lambda rng, seed, results: None)

    slow, quick_one = family("slow", 3, 10.0), family("quick", 40, 1.0)
    order = [index for index, _ in schedule((slow, quick_one))]
    assert order.count(0) == 3
    assert order.count(1) == 40
    assert 8 <= order[: order.index(0) + 1].count(1) <= 10
    *_, outcome = run_whole((slow, quick_one), 0, workers=Workers(1))
    assert [results.tried for results in outcome.results] == [3, 40]
    assert as_json(outcome)["share"] == 1.0


def short(*names: str) -> tuple[TrialFamily, ...]:
    """Families of six trials that are cut into three parts, where they may be."""
    return tuple(replace(family, full=6, cost_ms=5_000.0) for family in chosen(names))


def alike(one: Any, other: Any) -> None:
    """Equal, numbers nearly so: another process adds single precision up in another order."""
    assert type(one) is type(other)
    if isinstance(one, dict):
        assert set(one) == set(other)
        for key, value in one.items():
            alike(value, other[key])
    else:
        assert one == (pytest.approx(other, rel=0.03) if isinstance(one, float) else other)


def test_the_whole_list_in_two_processes_finds_what_one_finds() -> None:
    families = short("noise", "round", "times", "drift")
    assert [len([one for one in parts(families) if one.family == family]) for family in families] == [3, 3, 3, 1]
    alone = as_json(run(families, 7, math.inf))
    found = [as_json(outcome) for outcome in run_whole(families, 7, workers=Workers(2))]
    assert len(found) == 10
    alike({**found[-1], "spent_s": 0}, {**alone, "spent_s": 0})
    assert sorted(one["share"] for one in found) == [one["share"] for one in found]


def test_failures_of_all_parts_are_kept_as_in_one_run() -> None:
    def begin(product: ProductFunctions) -> Callable[[np.random.Generator, int, FamilyResults], None]:
        return lambda rng, seed, results: results.add_failure("nan" if seed == 55 else "crash", f"at {seed}")

    family = TrialFamily("odd", "", 60, 1_000.0, begin)
    alone = run((family,), 0, math.inf).results[0]
    *_, outcome = run_whole((family,), 0, workers=Workers(1))
    assert len(parts((family,))) == 6
    assert outcome.results[0].counts == alone.counts
    assert outcome.results[0].failures == alone.failures
    assert [one.seed for one in alone.failures] == [*range(KEPT_FAILURES), 55]


def test_an_interrupted_whole_list_leaves_what_it_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def begin(product: ProductFunctions) -> Callable[[np.random.Generator, int, FamilyResults], None]:
        def trial(rng: np.random.Generator, seed: int, results: FamilyResults) -> None:
            if seed >= 20:
                raise KeyboardInterrupt

        return trial

    monkeypatch.setattr("slipguard.stress.runner.FAMILIES", (TrialFamily("odd", "", 40, 1_000.0, begin),))
    assert cli(["stress", "--seconds", "0", "--jobs", "1", "--out", str(tmp_path)]) == 1
    assert "interrupted" in capsys.readouterr().err
    found = json.loads((tmp_path / "stress.json").read_text())
    assert (found["tried"], found["share"], found["crashes"]) == (20, 0.5, 0)


def test_the_command_tries_the_whole_list(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("slipguard.stress.runner.FAMILIES", short("times", "fusion"))
    assert cli(["stress", "--seconds", "0", "--jobs", "1", "--out", str(tmp_path)]) == 0
    found = json.loads((tmp_path / "stress.json").read_text())
    assert (found["tried"], found["share"]) == (12, 1.0)


def test_what_counts_as_confidently_wrong() -> None:
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


def test_the_float64_references_read_the_drawn_axis() -> None:
    for angle in (-80.0, -30.0, 0.0, 25.0, 70.0):
        drawn = soft(ELONGATED["ellipse"], ShapePose(angle))
        mask = (drawn > 0.5).astype(np.uint8)
        assert abs(math.remainder(second_moments_deg(drawn) - angle, 180.0)) < 0.1
        assert abs(math.remainder(fitted_ellipse_deg(mask) - angle, 180.0)) < 1.0


def test_turned_pictures_and_axes_agree() -> None:
    drawn = soft(ELONGATED["bar"], ShapePose(20.0, scale=0.8))
    for which in range(8):
        seen = second_moments_deg(np.asarray(rotated(drawn, which), np.float32))
        assert abs(math.remainder(seen - rotated_axis_deg(20.0, which), 180.0)) < 0.1


def test_there_are_masks_of_every_degenerate_kind() -> None:
    import cv2

    masks = degenerate()
    assert masks["empty"].sum() == 0
    assert masks["full"].all()
    assert cv2.connectedComponents(masks["10,000 components"])[0] - 1 >= 10_000
    assert all(mask.dtype == np.uint8 and mask.max() <= 1 for mask in masks.values())


def test_the_command_prints_json_and_writes_the_picture(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "stress"
    assert cli(["stress", "--only", "noise", "--only", "fusion", "--seconds", "0.1", "--json", "--out", str(out)]) == 0
    found = json.loads(capsys.readouterr().out)
    assert set(found) == {"tried", "share", "crashes", "nan", "confident_wrong", "worst", "drift_deg"}
    assert found["drift_deg"] is None
    assert (out / "error-against-noise.png").stat().st_size > 10_000
    written = json.loads((out / "stress.json").read_text())
    assert {key: written[key] for key in found} == found
    assert written["full_hours"] > 0.0


def test_the_command_prints_a_table_that_fits(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli(["stress", "--only", "seams", "--seconds", "0.01"]) == 0
    shown = capsys.readouterr().out
    assert "seams" in shown
    assert "of the full list" in " ".join(shown.split())


def test_what_is_found_wrong_is_exit_code_1(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("slipguard.stress.runner.ProductFunctions", lambda: ProductFunctions(fuse=broken_fuse("nan")))
    assert cli(["stress", "--only", "fusion", "--seconds", "0.05"]) == 1
    assert "again: slipguard stress --only fusion --seed" in " ".join(capsys.readouterr().out.split())


def test_an_unknown_family_is_refused_with_the_list(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(InputError, match="degenerate, random, equivariance"):
        chosen(["nonsense"])
    assert cli(["stress", "--only", "nonsense"]) == 2
    assert "there are degenerate" in capsys.readouterr().err
