"""The campaign of the grip controllers: its trials, its controllers and its report."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import typer

from slipguard.bench.grip import campaign, campaign_figures
from slipguard.bench.grip.group_statistics import FLOOR_DEG
from slipguard.bench.grip.perception_models import ModeledFinger, PerceptionErrors, RotationDrift
from slipguard.bench.grip.trial_run import CONTROLLER_NAMES, run_trial
from slipguard.bench.grip.trials import (
    FRAME_RATES,
    LATENCIES_S,
    PERCEIVING_S,
    SHARES,
    TEST_OBJECTS,
    GripTrial,
    draw,
    trials,
)
from slipguard.cli.bench import bench_grip
from slipguard.sim.friction import needed_force_n
from slipguard.sim.gel_view import GelView
from slipguard.tools.parallel import Workers

KEYS = (
    "scenarios", "rendered", "drops_avoidable", "turn_over_oracle_median", "turn_over_oracle_p95",
    "fixed_step_turn_over_ours_median", "false_tightenings", "force_over_needed_median",
)  # fmt: skip


def trial(share: float = 0.9, *, soft: bool = False, number: int = 3, name: str = "wrench") -> GripTrial:
    return draw(number, name, share, 0.1, soft, 60.0)


def test_the_matrix_has_all_combinations_and_a_part_of_it_is_balanced() -> None:
    every = trials(None, 100)
    assert len(every) == len(TEST_OBJECTS) * len(SHARES) * len(LATENCIES_S) * 2 * len(FRAME_RATES)
    assert sum(one.rendered for one in every) == 100
    some = trials(36, 0)
    for axis in (
        [one.item.name for one in some], [one.share for one in some], [one.latency_s for one in some],
        [one.soft for one in some], [one.fps for one in some],
    ):  # fmt: skip
        _, counts = np.unique(np.asarray(axis), return_counts=True)
        assert counts.max() - counts.min() <= 1
    assert [one.name for one in trials(12, 0)] == [one.name for one in some[:12]]
    assert [one.name for one in trials(12, 0, seed=1)] != [one.name for one in some[:12]]


@pytest.mark.parametrize("number", range(8))
def test_a_trial_needs_its_stated_force_and_is_gripped_with_its_share(number: int) -> None:
    one = draw(number, "bar", SHARES[number % 4], LATENCIES_S[number // 2], number % 2 == 0, 60.0)
    gripper, camera = one.scenario.gripper, one.scenario.left
    assert 45.0 * 0.97 < one.needed_n <= 78.0
    assert needed_force_n(one.item, one.scenario.gel) == pytest.approx(one.needed_n, rel=1e-6)
    assert one.first_n * gripper.gain == pytest.approx(one.share * one.needed_n)
    assert gripper.quantized_force_n(one.first_n) == pytest.approx(one.first_n)
    parts_s = camera.latency_s + PERCEIVING_S + 2.0 * gripper.transaction_s + gripper.dead_time_s
    assert parts_s == pytest.approx(one.latency_s)


def test_slipguard_is_close_to_the_oracle_and_better_than_a_fixed_step() -> None:
    outcomes = {who: run_trial(trial(), who) for who in CONTROLLER_NAMES}
    assert outcomes["slipguard"].dropped is None
    assert outcomes["slipguard"].slip_deg < 1.6 * max(outcomes["oracle"].slip_deg, FLOOR_DEG)
    assert outcomes["fixed step"].slip_deg > 1.5 * outcomes["slipguard"].slip_deg
    assert outcomes["unguarded"].slip_deg > outcomes["fixed step"].slip_deg
    assert outcomes["oracle"].tightenings == 1
    assert outcomes["oracle"].force_over_needed == pytest.approx(1.5, abs=0.03)
    assert outcomes["unguarded"].tightenings == 0
    assert run_trial(trial(), "slipguard") == outcomes["slipguard"]


def test_on_a_soft_gel_it_tightens_before_any_slip() -> None:
    outcome = run_trial(trial(soft=True), "slipguard")
    assert outcome.early
    assert outcome.slip_deg < 0.1


def test_removing_the_support_is_worse_than_a_lift() -> None:
    gone = run_trial(replace(trial(), event="support gone"), "slipguard", traced=True)
    assert gone.dropped is None
    assert gone.slip_deg > run_trial(trial(), "slipguard").slip_deg
    assert gone.arrested_s is not None
    assert 0.05 < gone.arrested_s < 0.6
    assert gone.trace is not None
    assert max(now.force_n for now in gone.trace) == gone.force_n


def test_the_error_model_takes_a_reference_and_has_the_given_errors() -> None:
    finger = ModeledFinger(
        PerceptionErrors(0.0, 0.1, 0.0, 0.2, 0.0), np.random.default_rng(1), RotationDrift(0.5, 40.0, 0.0)
    )
    at_rest = [finger.process(GelView("key", angle_deg=20.0, depth_mm=0.5), 0.02 * k, k) for k in range(6)]
    assert [one.rotation_deg is None for one in at_rest] == [True] * 4 + [False] * 2
    rotated = finger.process(GelView("key", angle_deg=40.0, depth_mm=0.5), 0.14, 7)
    assert rotated.rotation_deg == pytest.approx(20.0, abs=6.0)
    assert rotated.rotation_deg != pytest.approx(20.0, abs=1e-3)
    assert rotated.sigma_deg == 0.2
    assert not finger.process(GelView("key"), 0.16, 8).contact
    declining = ModeledFinger(PerceptionErrors(declined=1.0), np.random.default_rng(1))
    estimates = [declining.process(GelView("key", depth_mm=0.5), 0.02 * k, k) for k in range(6)]
    assert estimates[-1].declined is not None


@pytest.mark.campaign
def test_the_command_writes_json_and_plot(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Two lifts, one of them with rendered frames, one without support, one of each block, two seconds of holds."""
    quick = {"TRIALS": 2, "RENDERED": 1, "GONE": 1, "TIGHT": 1, "MINUTES": 0.025, "RENDERED_HOLDS": 1}
    for name, value in {**quick, "RENDERED_HOLD_S": 0.5}.items():
        monkeypatch.setattr(campaign, f"QUICK_{name}", value)
    monkeypatch.setattr(campaign, "HOLD_S", 1.5)
    monkeypatch.setattr(campaign_figures, "failures", lambda figures: [])  # there are too few trials for the limits
    bench_grip(quick=True, seed=0, json=True, out=tmp_path, workers=Workers(jobs=1))
    printed = capsys.readouterr()
    found = json.loads(printed.out)
    assert tuple(found)[: len(KEYS)] == KEYS
    assert (found["scenarios"], found["rendered"], found["drops_avoidable"]) == (2, 1, 0)
    assert (found["high_need"]["scenarios"], found["fragile"]["scenarios"], found["holds"]["rendered"]) == (1, 1, 1)
    assert [check["key"] for check in found["promised"]] == [bound.key for bound in campaign_figures.BOUNDS]
    assert "lifts with a grip that is too weak" in printed.err
    kept = json.loads((tmp_path / "grip.json").read_text())
    assert {key: kept[key] for key in found} == found
    assert [one["block"] for one in kept["trials"]] == ["matrix", "matrix", "matrix", "high need", "fragile"]
    assert len(kept["stable_holds"]) == 2
    assert (tmp_path / "grip.png").stat().st_size > 10_000


def test_the_command_fails_if_a_limit_is_exceeded(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    quick = {"TRIALS": 1, "RENDERED": 0, "GONE": 0, "TIGHT": 0, "MINUTES": 0.01, "RENDERED_HOLDS": 0}
    for name, value in quick.items():
        monkeypatch.setattr(campaign, f"QUICK_{name}", value)
    monkeypatch.setattr(campaign, "HOLD_S", 0.5)
    monkeypatch.setattr(campaign_figures, "failures", lambda figures: ["limit exceeded: something"])
    with pytest.raises(typer.Exit):
        bench_grip(quick=True, seed=0, json=False, out=None, workers=Workers(jobs=1))
    printed = capsys.readouterr()
    assert "limit exceeded: something" in printed.err
    assert "limits" in printed.out
