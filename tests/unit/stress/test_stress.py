"""The stress trials detect estimates that are wrong, NaN or declined too often, and print how to reproduce it."""

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
from sampled import sampled

from slipguard.cli.app import run as cli
from slipguard.control.finger_fusion import FusedEstimate, fuse
from slipguard.devices import Frame
from slipguard.errors import InputError
from slipguard.perception.estimate import Estimate
from slipguard.perception.pipeline import Pipeline
from slipguard.stress import run as stress
from slipguard.stress.masks import degenerate_masks
from slipguard.stress.perturbations import EFFECT_LEVELS, PERTURBATIONS
from slipguard.stress.run import SUMMARY, StressRun, run
from slipguard.stress.trial import ProductFunctions, TrialOutcome

FLAWS = {"biased": "confident wrong", "nan": "nan", "raising": "crash"}
ROWS = ("camera noise", "gain", "odd probability", "odd clock", "gap", "swing", "rocking")


def run_trials(names: list[str], trials: int, product: ProductFunctions | None = None, seed: int = 0) -> StressRun:
    """Run this many trials; the clock advances by one per trial."""
    ticks = itertools.count()
    return run(names, seed, float(trials), product, clock=lambda: float(next(ticks)))


def faulty(flaw: str, angle_deg: float | None, sigma_deg: float | None) -> tuple[float | None, float | None]:
    """Return a faulty angle and sigma."""
    if flaw == "raising":
        raise ValueError("broken on purpose")
    if angle_deg is None:
        return None, sigma_deg
    return (math.nan, 1.0) if flaw == "nan" else (0.5 * angle_deg + 20.0, 0.05)


def faulty_pipeline(flaw: str) -> type[Pipeline]:
    class Faulty(Pipeline):
        def process(self, frame: Frame) -> Estimate:
            answer = super().process(frame)
            angle, sigma = faulty(flaw, answer.rotation_deg, answer.sigma_deg)
            return replace(answer, rotation_deg=angle, sigma_deg=sigma)

    return Faulty


def faulty_fuse(flaw: str) -> Callable[[Estimate | None, Estimate | None], FusedEstimate | None]:
    def broken(left: Estimate | None, right: Estimate | None) -> FusedEstimate | None:
        fused = fuse(left, right)
        if fused is None:
            return None
        angle, sigma = faulty(flaw, fused.rotation_deg, fused.sigma_deg)
        return replace(fused, rotation_deg=angle, sigma_deg=sigma)

    return broken


class Declining:
    """A pipeline that declines every frame."""

    has_reference = False

    def __init__(self, *_: object, **__: object) -> None:
        pass

    def process(self, frame: Frame) -> Estimate:
        at_s = frame.captured_at_s
        return Estimate(frame.sequence, at_s, at_s, True, 4000, "model", declined="always declined")


@pytest.mark.parametrize("flaw", sampled(tuple(FLAWS)))
@pytest.mark.parametrize("name", ROWS)
def test_a_faulty_pipeline_is_detected(name: str, flaw: str) -> None:
    found = run_trials([name], 2, ProductFunctions(pipeline=faulty_pipeline(flaw)))
    if PERTURBATIONS[name].sweep and flaw == "biased":
        assert found.broken_at == {name: EFFECT_LEVELS["rocking"][0]}
    else:
        assert found.perturbations[name].count(FLAWS[flaw]) > 0  # type: ignore[arg-type]


@pytest.mark.parametrize("flaw", FLAWS)
def test_a_faulty_fusion_is_detected(flaw: str) -> None:
    found = run_trials(["camera noise"], 1, ProductFunctions(fuse=faulty_fuse(flaw)))
    assert found.perturbations["camera noise"].count(FLAWS[flaw]) > 0  # type: ignore[arg-type]


def test_an_image_without_a_gel_for_which_a_rotation_is_claimed_is_detected() -> None:
    product = ProductFunctions(pipeline=faulty_pipeline("biased"))
    for name in ("no gel image", "round contact"):
        outcome = TrialOutcome(0.0)
        outcome.check_angle(name, 20.0, 0.05, None)
        assert [kind for kind, _ in outcome.failures] == ["confident wrong"]
    assert run_trials(["no gel image"], 1, product).failures


def test_a_drift_of_a_tenth_of_a_degree_is_detected() -> None:
    class Drifting(Pipeline):
        def process(self, frame: Frame) -> Estimate:
            answer = super().process(frame)
            off = 5e-3 * frame.sequence
            return answer if answer.rotation_deg is None else replace(answer, rotation_deg=answer.rotation_deg + off)

    assert run_trials(["swing"], 1).as_json()["drift_deg"] < 0.05
    found = run_trials(["swing"], 1, ProductFunctions(pipeline=Drifting))
    assert found.as_json()["drift_deg"] > 0.1
    assert found.perturbations["swing"].count("limit") > 0


@pytest.mark.parametrize("name", sampled([name for name, one in PERTURBATIONS.items() if one.least_answered]))
def test_a_pipeline_that_declines_everything_fails_where_estimates_are_possible(name: str) -> None:
    found = run_trials([name], 9, ProductFunctions(pipeline=Declining))
    assert [failure.kind for failure in found.failures] == ["limit"]
    assert "the minimum is" in found.failures[0].what


def test_the_share_of_estimates_is_not_judged_after_few_trials() -> None:
    assert not run_trials(["camera noise"], 2, ProductFunctions(pipeline=Declining)).failures


@pytest.mark.campaign
def test_a_quick_run_tries_every_perturbation_without_failure() -> None:
    found = run_trials([], 1)
    assert not found.failures
    assert found.tried == len(PERTURBATIONS)
    assert found.as_json()["drift_deg"] <= 0.1


def test_equal_seeds_give_equal_results_and_the_seed_of_a_failure_reproduces_it() -> None:
    def figures(seed: int) -> dict[str, Any]:
        return {key: value for key, value in run_trials(["JPEG"], 2, seed=seed).as_json().items() if key != "spent_s"}

    assert figures(5) == figures(5) != figures(6)
    product = ProductFunctions(pipeline=faulty_pipeline("biased"))
    first = run_trials(["gap"], 3, product, seed=100).first_failures[0]
    assert run_trials(["gap"], 1, product, seed=first.seed).first_failures[0] == first


def test_an_error_counts_as_confidently_wrong_beyond_its_sigmas() -> None:
    for angle, sigma, truth, wrong in (
        (10.0, 2.0, 0.0, True), (10.0, 2.6, 0.0, False), (0.5, 0.1, 0.0, True), (10.0, 3.0, None, True),
        (10.0, 3.4, None, False), (2.9, 0.1, None, False), (None, None, 0.0, False), (math.nan, 1.0, 0.0, True),
        (0.0, 0.0, 0.0, True), (0.0, None, 0.0, True), (math.inf, 1.0, None, True),
    ):  # fmt: skip
        outcome = TrialOutcome(0.0)
        outcome.check_angle("x", angle, sigma, truth)
        assert bool(outcome.failures) is wrong, (angle, sigma, truth)


def test_the_full_list_takes_all_perturbations_in_turn_and_covers_their_levels() -> None:
    planned = stress.cases([], 7, ProductFunctions())
    assert [case.name for case in planned[: len(PERTURBATIONS)]] == list(PERTURBATIONS)
    assert len({(case.name, case.seed) for case in planned}) == len(planned)
    for name, one in PERTURBATIONS.items():
        few = {one.level(case.seed) for case in planned if case.name == name and case.seed < 7 + 3 * len(one.levels)}
        assert few == set(one.levels)
    assert {str(case) for case in planned[:1]} == {"camera noise, seed 7"}


def test_degenerate_masks_are_valid() -> None:
    masks = degenerate_masks()
    assert masks["empty"].sum() == 0
    assert masks["full"].all()
    assert all(mask.dtype == np.uint8 and mask.shape == (160, 120) and mask.max() <= 1 for mask in masks.values())


def test_the_command_prints_json_and_writes_the_plot(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "stress"
    assert cli(["stress", "--only", "gap", "--only", "lamp", "--seconds", "0.001", "--json", "--out", str(out)]) == 0
    found = json.loads(capsys.readouterr().out)
    assert tuple(found) == SUMMARY
    assert found["drift_deg"] is None
    assert (out / "error-against-noise.png").stat().st_size > 10_000
    written = json.loads((out / "stress.json").read_text())
    assert {key: written[key] for key in found} == found


def test_the_table_fits_into_80_columns_and_a_failure_gives_exit_code_1(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setattr(stress, "ProductFunctions", lambda: ProductFunctions(fuse=faulty_fuse("nan")))
    assert cli(["stress", "--only", "swapped colors", "--seconds", "0.001"]) == 1
    shown = capsys.readouterr().out
    assert "…" not in shown
    for head in ("perturbation", "tried", "mated", "crash", "NaN", "wrong", "limit", "worst"):
        assert head in shown
    assert 'reproduce: slipguard stress --only "swapped colors" --seed 0' in " ".join(shown.split())


def test_an_unknown_perturbation_is_refused_with_the_known_ones(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(InputError, match="camera noise, gain"):
        run(["nonsense"], 0)
    assert cli(["stress", "--only", "nonsense"]) == 2
    assert "Choose from camera noise" in capsys.readouterr().err
