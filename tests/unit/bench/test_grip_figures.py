"""Figures of the grip bench: dominance, false tightenings, limits, tables and plot."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console

from slipguard.bench.grip import figures
from slipguard.bench.grip.campaign import (
    BASELINES,
    BOUND,
    NAIVE,
    REACTING,
    REACTIVE,
    CampaignPlan,
    GripCampaignResult,
    ScenarioResult,
)
from slipguard.bench.grip.json_figures import LIMITS, as_json, checks, failures, scenarios_as_json
from slipguard.bench.grip.lift_course import Disturbed, GripOutcome
from slipguard.bench.grip.plot import draw
from slipguard.bench.grip.report import print_tables
from slipguard.bench.grip.scenarios import scenarios

OLD_KEYS = {
    "scenarios", "rendered", "drops_avoidable", "turn_over_oracle_median", "turn_over_oracle_p95",
    "fixed_step_turn_over_ours_median", "false_tightenings", "force_over_needed_median",
    "fixed_step_turn_over_ours_at_0_97", "rendered_against_model", "ended_without_need", "holds_failed",
    "slip_floor_deg", "turn_over_oracle_median_floor_0_1", "turn_over_oracle_p95_floor_0_1", "arrest_s_median",
    "steps_median", "steps_max", "by_gel", "by_first_grip", "support_gone", "high_need", "fragile", "holds",
}  # fmt: skip
NEW_KEYS = {
    "plant", "seed_set", "force_over_needed_p95", "slip_p95_deg", "slip_worst_deg", "drops_beyond_bound",
    "firm_tightened_share", "dominated_by", "physical_bound",
    "added_mass", "firm", "firm_tightened_while_held_share", "onset_to_command_s_median",
}  # fmt: skip
PLAN = replace(CampaignPlan.of(quick=True), scenarios=tuple(scenarios(40, 0)))


def outcome(name: str, needed_n: float, over: float = 1.2, slip_deg: float = 1.0, tightenings: int = 0) -> GripOutcome:
    return GripOutcome(name, slip_deg, 0.1, over * needed_n, needed_n, 0.1, tightenings, False, None, None, True)


def disturbed(name: str, *, after_n: float = 40.0, dropped: bool = False) -> Disturbed:
    return Disturbed(name, 40.0, after_n, 0.2, dropped)


def campaign(
    *, ours: tuple[float, float] = (1.2, 1.0), constants: tuple[float, float] = (3.0, 0.0), firm_tightened: int = 0
) -> GripCampaignResult:
    """A campaign in which every controller does equally on every scenario; tuples: force over needed, slip."""
    results = []
    for one in PLAN.scenarios:
        made = {name: outcome(name, one.needed_n, *constants) for name in BASELINES}
        made |= {name: outcome(name, one.needed_n, constants[0], constants[1] + 8.0) for name in NAIVE}
        made[BOUND] = outcome(BOUND, one.needed_n, 1.02, 0.2)
        made[REACTIVE] = outcome(REACTIVE, one.needed_n, 1.3, 0.4)
        made["slipguard"] = outcome("slipguard", one.needed_n, *ours, firm_tightened if one.firm else 1)
        results.append(ScenarioResult(one, made))
    return GripCampaignResult(PLAN, tuple(results))


def test_a_baseline_that_is_better_in_slip_and_force_is_named() -> None:
    assert as_json(campaign())["dominated_by"] == []
    assert as_json(campaign(ours=(1.2, 1.0), constants=(1.1, 0.9)))["dominated_by"] == [
        name for name in BASELINES if name not in NAIVE
    ]
    assert as_json(campaign(ours=(1.2, 1.0), constants=(1.2, 1.0)))["dominated_by"] == []


def test_tightening_a_firm_grasp_during_the_lift_is_a_false_tightening() -> None:
    found = as_json(campaign(firm_tightened=1))
    holds = found["holds"]
    assert isinstance(holds, dict)
    assert found["firm_tightened_share"] == 1.0
    assert found["false_tightenings"] == holds["false_while_lifted"] == holds["count"] > 0
    assert any("firm grasps" in line for line in failures(found))
    assert as_json(campaign())["false_tightenings"] == 0


def test_lifts_that_no_actuator_can_answer_are_stated_apart() -> None:
    found = campaign()
    first = next(one for one in found.results if one.scenario.weak)
    first.outcomes[BOUND] = replace(first.outcomes[BOUND], slip_deg=20.0)
    assert found.beyond_actuator == [first]
    assert first not in found.weak
    beyond = as_json(found)["beyond_actuator"]
    assert isinstance(beyond, dict)
    assert beyond["slip_over_bound_median_deg"] == pytest.approx(-19.0)


def test_the_slip_is_stated_against_the_bound_that_reacts_to_what_the_cameras_see() -> None:
    found = campaign()
    weak = [one for one in found.results if one.scenario.weak]
    weak[0].outcomes[REACTIVE] = replace(weak[0].outcomes[REACTIVE], slip_deg=8.0)
    weak[0].outcomes["slipguard"] = replace(weak[0].slipguard, slip_deg=9.0)
    bound = as_json(found)["physical_bound"]
    assert isinstance(bound, dict)
    assert (bound["weak"], bound["avoidable"]) == (len(weak), len(weak) - 1)
    assert bound["slip_over_reactive_p95_deg"] == pytest.approx(0.6, abs=0.1)
    assert bound["controllers"][0]["slip_worst_deg"] == 1.0  # the others


def test_a_firm_grasp_that_is_tightened_while_held_is_counted_once() -> None:
    found = campaign()
    one = found.firm[0]
    tighter = tuple(disturbed(name, after_n=50.0) for name in ("bump", "lowering"))
    one.outcomes["slipguard"] = replace(one.slipguard, disturbed=tighter)
    shown = as_json(found)
    assert (shown["firm"], shown["firm_tightened_while_held_share"]) == (len(found.firm), 1.0)
    assert shown["holds"]["false_while_holding"] == 2
    assert any("lowering" in line for line in failures(shown))


def test_a_disturbance_that_drops_what_the_bound_holds_is_a_failure() -> None:
    found = campaign()
    one = found.results[0]
    one.outcomes["slipguard"] = replace(one.slipguard, disturbed=(disturbed("bump", dropped=True),))
    assert as_json(found)["disturbances"]["bump"]["drops_beyond_bound"] == 0  # the bound was not disturbed
    one.outcomes[BOUND] = replace(one.outcomes[BOUND], disturbed=(disturbed("bump"),))
    assert as_json(found)["disturbances"]["bump"]["drops_beyond_bound"] == 1
    assert any("by a disturbance" in line for line in failures(as_json(found)))


def test_the_naive_law_is_compared_at_equal_force() -> None:
    found = campaign(ours=(1.2, 2.0))
    for one in found.weak:
        for name, over, slip_deg in zip(NAIVE, (1.0, 1.4, 1.6, 1.8), (10.0, 4.0, 3.0, 2.0), strict=True):
            one.outcomes[name] = outcome(name, one.scenario.needed_n, over, slip_deg)
    equal = as_json(found)["naive_at_equal_force"]
    assert (equal["naive_slip_p95_deg"], equal["ratio"]) == (7.0, pytest.approx(2.0 / 7.0, abs=1e-3))


def test_a_drop_that_the_bound_would_not_have_is_counted() -> None:
    found = campaign()
    first = found.results[0]
    first.outcomes["slipguard"] = replace(first.slipguard, dropped="contact lost", slip_deg=60.0)
    assert as_json(found)["drops_beyond_bound"] == 1
    first.outcomes[BOUND] = replace(first.outcomes[BOUND], dropped="contact lost")
    assert as_json(found)["drops_beyond_bound"] == 0


def test_the_json_keeps_its_keys_and_every_limit_has_a_value() -> None:
    found = as_json(campaign())
    assert set(found) >= OLD_KEYS | NEW_KEYS
    assert (found["seed_set"], found["plant"]) == ("tuning", "own")
    assert len(checks(found)) == len(LIMITS)
    assert failures(found) == []
    assert all(check.as_json()["not_held_in"] == [] for check in checks(found))
    assert set(found["holds"]) >= {"count", "minutes", "tightened_while_slipping"}  # type: ignore[call-overload]
    assert len(failures(as_json(campaign(ours=(2.5, 11.0))))) == 6
    trials = scenarios_as_json(campaign())["trials"]
    assert isinstance(trials, list)
    assert {"event", "needed_n", "slipguard", "clairvoyant", "constant_0.50"} <= set(trials[0])


def test_a_limit_that_some_lifts_exceed_names_their_group() -> None:
    found = campaign()
    for one in found.weak:
        if one.scenario.pad == "soft":
            one.outcomes["slipguard"] = replace(one.slipguard, slip_deg=5.0)
    (check,) = (one for one in checks(as_json(found)) if one.limit.key == "slip_p95_deg")
    assert "soft" in check.as_json()["not_held_in"]  # type: ignore[operator]
    assert "stiff" not in check.as_json()["not_held_in"]  # type: ignore[operator]


def test_tables_and_plot_show_every_baseline(tmp_path: Path) -> None:
    console = Console(width=80, record=True, file=io.StringIO())
    print_tables(console, [campaign(), campaign()])
    text = console.export_text()
    for name in ("slipguard", *BASELINES, BOUND, REACTIVE, *REACTING):
        assert name in text
    assert "…" not in text
    draw([campaign(), campaign()], tmp_path / "grip.png")
    assert (tmp_path / "grip.png").stat().st_size > 10_000


def test_an_empty_campaign_has_figures() -> None:
    found = as_json(GripCampaignResult(PLAN, ()))
    assert (found["slip_p95_deg"], found["dominated_by"], found["false_tightenings"]) == (None, [], 0)
    assert figures.pareto_rows([]) == []
