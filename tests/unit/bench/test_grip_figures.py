"""What the campaign's figures say of what was played, and which of them fail it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from slipguard.bench.grip import campaign_figures as figures
from slipguard.bench.grip import campaign_figures as verdict
from slipguard.bench.grip import group_statistics as rows
from slipguard.bench.grip.campaign import CampaignResult, TrialOutcomes
from slipguard.bench.grip.campaign_figures import BOUNDS, FigureLimit
from slipguard.bench.grip.stable_holds import HoldOutcome, StableHold
from slipguard.bench.grip.trial_run import CONTROLLER_NAMES, TrialOutcome
from slipguard.bench.grip.trials import GripTrial, draw


def trial(share: float = 0.9, *, soft: bool = False) -> GripTrial:
    return draw(3, "wrench", share, 0.1, soft, 60.0)


def made(slip_deg: float, dropped: str | None = None) -> TrialOutcome:
    return TrialOutcome("law", slip_deg, slip_deg, 90.0, 60.0, 0.1, 1, False, dropped)


def played(law: TrialOutcome, oracle: TrialOutcome, of: GripTrial | None = None) -> TrialOutcomes:
    others = {who: made(5.0) for who in CONTROLLER_NAMES}
    return TrialOutcomes(of or trial(), {**others, "law": law, "oracle": oracle})


def held(false: int = 0, lifting: int = 0, failed: str | None = None, *, soft: bool = False) -> HoldOutcome:
    return HoldOutcome(StableHold(trial(soft=soft), 1.5, 60.0), false, lifting, false, lifting, 60.0, 0.0, 1.0, failed)


def found(
    *trials: TrialOutcomes, gone: tuple[TrialOutcomes, ...] = (), holds: tuple[HoldOutcome, ...] = ()
) -> CampaignResult:
    return CampaignResult(trials, gone, (), (), holds)


def test_ratios_leave_out_drops_and_do_not_compare_noughts() -> None:
    some = [played(made(2.0), made(1.0)), played(made(0.0), made(0.2)), played(made(60.0, "contact lost"), made(30.0))]
    assert rows.ratios(some, "law", "oracle") == [2.0, 1.0]
    assert rows.row("all", some).drops["law"] == 1
    assert figures.agreement(some) is None
    both = [replace(some[0], rendered=made(2.2))]
    alike = figures.agreement(both)
    assert alike is not None
    assert alike.apart == pytest.approx(0.1)
    assert both[0].law.slip_deg == 2.2


def test_a_row_tells_steps_and_the_time_to_arrest() -> None:
    law = [
        replace(made(1.0), tightenings=k, arrested_s=arrested_s) for k, arrested_s in ((0, None), (1, 0.2), (4, 0.6))
    ]
    one = rows.row("all", [played(outcome, made(1.0)) for outcome in law])
    assert (one.steps_median, one.steps_max) == (1.0, 4)
    assert (one.arrested_s, one.arrested_max_s) == (pytest.approx(0.4), 0.6)


def test_a_drop_counts_in_every_block_and_through_rendered_frames() -> None:
    lost = made(61.0, "rotated more than 60 deg")
    gone = replace(trial(), event="support gone")
    assert rows.dropped_for_nothing(played(lost, made(1.0)))
    assert rows.dropped_for_nothing(played(lost, lost))
    assert rows.dropped_for_nothing(replace(played(made(1.0), made(1.0)), rendered=lost))
    assert rows.dropped_for_nothing(played(lost, made(1.0), gone))
    assert not rows.dropped_for_nothing(played(lost, lost, gone)), "gone before any motor can act"
    told = figures.as_json(found(played(made(1.0), made(1.0)), gone=(played(lost, made(1.0), gone),)))
    assert told["drops_avoidable"] == 1


@pytest.mark.parametrize("outcome", [replace(made(1.0), fault="budget spent"), replace(made(1.0), up=False)])
def test_a_lift_given_up_without_need_counts(outcome: TrialOutcome) -> None:
    assert rows.ended_for_nothing(played(outcome, made(1.0)))
    assert not rows.ended_for_nothing(played(made(1.0), outcome))
    assert not rows.ended_for_nothing(played(replace(outcome, dropped="contact lost"), made(1.0))), (
        "a drop, told as such"
    )
    assert figures.as_json(found(played(outcome, made(1.0))))["ended_without_need"] == 1
    gone = replace(trial(), event="support gone")
    assert rows.ended_for_nothing(played(outcome, made(40.0), gone))
    assert not rows.ended_for_nothing(played(outcome, made(50.0), gone)), "the oracle's, too, had turned too far"
    assert rows.ended_for_nothing(played(outcome, made(50.0))), "no excuse in a lift"


def test_gels_and_first_grips_are_told_beside_the_whole() -> None:
    soft = [played(made(1.0), made(1.0), trial(0.97, soft=True)) for _ in range(3)]
    told: dict[str, Any] = figures.as_json(
        found(*soft, played(made(3.0), made(1.0), trial(0.5)), holds=(held(2, 1, soft=True), held()))
    )
    assert told["turn_over_oracle_median"] == 1.0
    assert told["by_gel"]["stiff"]["turn_over_oracle_median"] == 3.0
    assert told["by_gel"]["soft"]["turn_over_oracle_median"] == 1.0
    assert told["by_gel"]["soft"]["fixed_step_turn_over_ours_at_0_97"] == 5.0
    assert told["by_first_grip"]["0.50"]["turn_over_oracle_p95"] == 3.0
    assert told["by_gel"]["stiff"]["by_first_grip"]["0.50"]["scenarios"] == 1
    assert told["false_tightenings"] == told["by_gel"]["soft"]["false_tightenings"] == 1
    assert (told["holds"]["false_while_holding"], told["holds"]["false_while_lifted"]) == (1, 1)
    assert any("stiff alone" in line and "p95" in line for line in verdict.remarks(told))


def fine() -> dict[str, Any]:
    values = {bound.key: bound.at_most if bound.at_most is not None else bound.at_least for bound in BOUNDS}
    return {**values, "by_gel": {"stiff": dict(values), "soft": dict(values)}, "high_need": None, "fragile": None}


@pytest.mark.parametrize("bound", BOUNDS, ids=lambda bound: bound.key)
def test_every_promise_is_checked_and_a_group_that_misses_it_is_told(bound: FigureLimit) -> None:
    assert verdict.failures(fine()) == []
    assert verdict.remarks(fine()) == []
    limit = bound.at_most if bound.at_most is not None else bound.at_least
    assert limit is not None
    missed = limit + 1.0 if bound.at_most is not None else limit - 1.0
    [line] = verdict.failures({**fine(), bound.key: missed})
    assert bound.title in line
    assert verdict.failures({**fine(), bound.key: None}) == []
    figures_of = fine()
    figures_of["by_gel"]["stiff"][bound.key] = missed
    assert verdict.failures(figures_of) == []
    [line] = verdict.remarks(figures_of)
    assert line.startswith("stiff alone")
    [check] = [check.as_json() for check in verdict.checks(figures_of) if check.bound is bound]
    assert (check["held"], check["not_held_in"]) == (True, ["stiff"])


def test_a_hold_that_never_began_fails_the_campaign() -> None:
    told = figures.as_json(found(played(made(1.0), made(1.0)), holds=(held(failed="not holding"), held())))
    assert told["holds_failed"] == 1
    assert any("holds that failed" in line for line in verdict.failures(told))
