"""The figures of a campaign, and the limits that fail it."""

from __future__ import annotations

from dataclasses import replace
from io import StringIO
from typing import Any, cast

import pytest
from rich.console import Console

from slipguard.bench.grip import campaign_figures as figures
from slipguard.bench.grip import group_statistics as rows
from slipguard.bench.grip.campaign import GripCampaignResult, TrialOutcomes
from slipguard.bench.grip.campaign_figures import BOUNDS, FigureLimit
from slipguard.bench.grip.report import print_tables
from slipguard.bench.grip.stable_holds import HoldOutcome, StableHold
from slipguard.bench.grip.trial_run import CONTROLLER_NAMES, TrialOutcome
from slipguard.bench.grip.trials import SHARES, GripTrial, draw


def trial(share: float = 0.9, *, soft: bool = False) -> GripTrial:
    return draw(3, "wrench", share, 0.1, soft, 60.0)


def made(slip_deg: float, dropped: str | None = None) -> TrialOutcome:
    return TrialOutcome("slipguard", slip_deg, slip_deg, 90.0, 60.0, 0.1, 1, False, dropped)


def played(product: TrialOutcome, oracle: TrialOutcome, of: GripTrial | None = None) -> TrialOutcomes:
    others = {who: made(5.0) for who in CONTROLLER_NAMES}
    return TrialOutcomes(of or trial(), {**others, "slipguard": product, "oracle": oracle})


def held(false: int = 0, lifting: int = 0, failed: str | None = None, *, soft: bool = False) -> HoldOutcome:
    return HoldOutcome(StableHold(trial(soft=soft), 1.5, 60.0), false, lifting, false, lifting, 60.0, 0.0, 1.0, failed)


def found(
    *trials: TrialOutcomes, gone: tuple[TrialOutcomes, ...] = (), holds: tuple[HoldOutcome, ...] = ()
) -> GripCampaignResult:
    return GripCampaignResult(trials, gone, (), (), holds)


def test_ratios_exclude_drops_and_tiny_slips() -> None:
    some = [played(made(2.0), made(1.0)), played(made(0.0), made(0.2)), played(made(60.0, "contact lost"), made(30.0))]
    assert rows.ratios(some, "slipguard", "oracle") == [2.0, 1.0]
    assert rows.row("all", some).drops["slipguard"] == 1
    assert figures.agreement(some) is None
    both = [replace(some[0], rendered=made(2.2))]
    alike = figures.agreement(both)
    assert alike is not None
    assert alike.apart == pytest.approx(0.1)
    assert both[0].slipguard.slip_deg == 2.2


def test_a_row_contains_steps_and_the_time_to_arrest() -> None:
    outcomes = [
        replace(made(1.0), tightenings=k, arrested_s=arrested_s) for k, arrested_s in ((0, None), (1, 0.2), (4, 0.6))
    ]
    one = rows.row("all", [played(outcome, made(1.0)) for outcome in outcomes])
    assert (one.steps_median, one.steps_max) == (1.0, 4)
    assert (one.arrested_s, one.arrested_max_s) == (pytest.approx(0.4), 0.6)


def test_a_drop_counts_in_every_block_and_with_rendered_frames() -> None:
    lost = made(61.0, "rotated more than 60 deg")
    gone = replace(trial(), event="support gone")
    assert rows.avoidable_drop(played(lost, made(1.0)))
    assert rows.avoidable_drop(played(lost, lost))
    assert rows.avoidable_drop(replace(played(made(1.0), made(1.0)), rendered=lost))
    assert rows.avoidable_drop(played(lost, made(1.0), gone))
    assert not rows.avoidable_drop(played(lost, lost, gone)), "falls before any motor can act"
    reported = figures.as_json(found(played(made(1.0), made(1.0)), gone=(played(lost, made(1.0), gone),)))
    assert reported["drops_avoidable"] == 1


@pytest.mark.parametrize("outcome", [replace(made(1.0), fault="budget spent"), replace(made(1.0), up=False)])
def test_an_avoidable_stop_counts(outcome: TrialOutcome) -> None:
    assert rows.avoidable_end(played(outcome, made(1.0)))
    assert not rows.avoidable_end(played(made(1.0), outcome))
    assert not rows.avoidable_end(played(replace(outcome, dropped="contact lost"), made(1.0))), "counts as a drop"
    assert figures.as_json(found(played(outcome, made(1.0))))["ended_without_need"] == 1
    gone = replace(trial(), event="support gone")
    assert rows.avoidable_end(played(outcome, made(40.0), gone))
    assert not rows.avoidable_end(played(outcome, made(50.0), gone)), "the oracle rotated too far, too"
    assert rows.avoidable_end(played(outcome, made(50.0))), "no exception in a lift"


def test_figures_are_reported_by_gel_and_first_grip() -> None:
    soft = [played(made(1.0), made(1.0), trial(0.97, soft=True)) for _ in range(3)]
    reported: dict[str, Any] = figures.as_json(
        found(*soft, played(made(3.0), made(1.0), trial(0.5)), holds=(held(2, 1, soft=True), held()))
    )
    assert reported["turn_over_oracle_median"] == 1.0
    assert reported["by_gel"]["stiff"]["turn_over_oracle_median"] == 3.0
    assert reported["by_gel"]["soft"]["turn_over_oracle_median"] == 1.0
    assert reported["by_gel"]["soft"]["fixed_step_turn_over_ours_at_0_97"] == 5.0
    assert reported["by_first_grip"]["0.50"]["turn_over_oracle_p95"] == 3.0
    assert reported["by_gel"]["stiff"]["by_first_grip"]["0.50"]["scenarios"] == 1
    assert reported["false_tightenings"] == reported["by_gel"]["soft"]["false_tightenings"] == 1
    assert (reported["holds"]["false_while_holding"], reported["holds"]["false_while_lifted"]) == (1, 1)
    assert any("stiff only" in line and "p95" in line for line in figures.remarks(reported))


def fine() -> dict[str, Any]:
    values = {bound.key: bound.at_most if bound.at_most is not None else bound.at_least for bound in BOUNDS}
    return {**values, "by_gel": {"stiff": dict(values), "soft": dict(values)}, "high_need": None, "fragile": None}


@pytest.mark.parametrize("bound", BOUNDS, ids=lambda bound: bound.key)
def test_every_limit_is_checked_and_an_exceeding_group_is_reported(bound: FigureLimit) -> None:
    assert figures.failures(fine()) == []
    assert figures.remarks(fine()) == []
    limit = bound.at_most if bound.at_most is not None else bound.at_least
    assert limit is not None
    missed = limit + 1.0 if bound.at_most is not None else limit - 1.0
    [line] = figures.failures({**fine(), bound.key: missed})
    assert bound.title in line
    assert figures.failures({**fine(), bound.key: None}) == []
    figures_of = fine()
    figures_of["by_gel"]["stiff"][bound.key] = missed
    assert figures.failures(figures_of) == []
    [line] = figures.remarks(figures_of)
    assert line.startswith("stiff only")
    [check] = [check.as_json() for check in figures.checks(figures_of) if check.bound is bound]
    assert (check["held"], check["not_held_in"]) == (True, ["stiff"])


def test_a_failed_hold_fails_the_campaign() -> None:
    reported = figures.as_json(found(played(made(1.0), made(1.0)), holds=(held(failed="not holding"), held())))
    assert reported["holds_failed"] == 1
    assert any("failed holds" in line for line in figures.failures(reported))


def test_the_tables_fit_80_columns() -> None:
    soft = [played(made(0.812), made(2.06), trial(share, soft=True)) for share in SHARES]
    stiff = [played(made(123.456), made(10.0), trial(share)) for share in SHARES]
    tight = (played(made(123.456), made(10.0)), played(made(3.3333), made(1.7)))
    everything = GripCampaignResult((*soft, *stiff), tuple(stiff), tight, tight, (held(2, 1, soft=True), held()))
    console = Console(width=80, file=StringIO())
    print_tables(console, everything)
    text = cast("StringIO", console.file).getvalue()
    assert "…" not in text
    assert max(map(len, text.splitlines())) <= 80
