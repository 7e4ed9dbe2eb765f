"""The whole campaign: every trial for everybody, some of them through rendered frames as well, and the stable holds.

Beside the matrix, as blocks of their own: the support goes away at once; the need is close to the budget, so that one
step is not enough; and the same with the small budget of something fragile.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, replace

from slipguard.bench.grip.stable_holds import HoldOutcome, StableHold, hold, holds
from slipguard.bench.grip.trial_run import CONTROLLER_NAMES, ControllerName, TrialOutcome, play
from slipguard.bench.grip.trials import Block, Event, GripTrial, trials
from slipguard.tools.parallel import Workers, each

QUICK_TRIALS, FULL_TRIALS = 32, None
QUICK_RENDERED, FULL_RENDERED = 20, 100
QUICK_GONE, FULL_GONE = 12, 144
"""Trials whose support goes away at once."""
QUICK_TIGHT, FULL_TIGHT = 8, 144
"""Trials of high need, and as many of fragile things."""
QUICK_MINUTES, FULL_MINUTES = 3.0, 60.0
HOLD_S = 60.0
QUICK_RENDERED_HOLDS, FULL_RENDERED_HOLDS = 1, 6
QUICK_RENDERED_HOLD_S, FULL_RENDERED_HOLD_S = 4.0, 30.0
SUPPORT_GONE_NUMBERS = 5_000
TRIAL_CPU_S, TIGHT_CPU_S, RENDERED_CPU_S, HOLD_CPU_S = 0.45, 0.8, 3.0, 2.8
"""What one of each costs on one core of a shared EPYC machine; a hold is a minute."""
RENDERED_HOLD_CPU_S, RENDERED_LIFT_S = 1.5, 4.0
"""A second of a rendered hold; what comes before it counts as so many."""


@dataclass(frozen=True, slots=True)
class CampaignPlan:
    """What is to be played. minutes: of stable holds."""

    trials: tuple[GripTrial, ...]
    gone: tuple[GripTrial, ...]
    tight: tuple[GripTrial, ...]
    holds: tuple[StableHold, ...]

    @classmethod
    def of(cls, *, quick: bool, seed: int = 0) -> CampaignPlan:
        """The quick plan, or all of the matrix. The same seed gives the same plan."""
        lifted = trials(QUICK_TRIALS if quick else FULL_TRIALS, QUICK_RENDERED if quick else FULL_RENDERED, seed)
        dropped = [
            replace(trial, event="support gone", number=SUPPORT_GONE_NUMBERS + trial.number)
            for trial in trials(QUICK_GONE if quick else FULL_GONE, 0, seed + 1)
        ]
        count = QUICK_TIGHT if quick else FULL_TIGHT
        tight = [*trials(count, 0, seed + 2, "high need"), *trials(count, 0, seed + 3, "fragile")]
        held = holds(QUICK_MINUTES if quick else FULL_MINUTES, seed, HOLD_S)
        drawn, each_s = QUICK_RENDERED_HOLDS, QUICK_RENDERED_HOLD_S
        if not quick:
            drawn, each_s = FULL_RENDERED_HOLDS, FULL_RENDERED_HOLD_S
        seen = holds(drawn * each_s / 60.0, seed, each_s, rendered=True) if drawn else []
        return cls(tuple(lifted), tuple(dropped), tuple(tight), (*held, *seen))

    @property
    def rendered(self) -> int:
        """Trials that go through rendered frames and the shipped network."""
        return sum(trial.rendered for trial in self.trials)

    def seconds(self, workers: Workers) -> float:
        """About how long it takes on this machine's cores."""
        cores = workers.jobs or os.cpu_count() or 1
        trials_s = TRIAL_CPU_S * (len(self.trials) + len(self.gone)) + TIGHT_CPU_S * len(self.tight)
        seen = [one for one in self.holds if one.rendered]
        seen_s = RENDERED_HOLD_CPU_S * sum(RENDERED_LIFT_S + one.seconds for one in seen)
        holds_s = HOLD_CPU_S * (len(self.holds) - len(seen))
        return (trials_s + RENDERED_CPU_S * self.rendered + holds_s + seen_s) / cores


@dataclass(frozen=True, slots=True)
class TrialOutcomes:
    """One trial: how it went for everybody with the error model, and for the law through rendered frames."""

    trial: GripTrial
    outcomes: dict[ControllerName, TrialOutcome]
    rendered: TrialOutcome | None = None

    @property
    def law(self) -> TrialOutcome:
        """slipguard's outcome: with rendered frames where there is one."""
        return self.outcomes["law"] if self.rendered is None else self.rendered


@dataclass(frozen=True, slots=True)
class CampaignResult:
    """All that was played."""

    trials: tuple[TrialOutcomes, ...]
    gone: tuple[TrialOutcomes, ...]
    high_need: tuple[TrialOutcomes, ...]
    fragile: tuple[TrialOutcomes, ...]
    holds: tuple[HoldOutcome, ...]


def run(plan: CampaignPlan, workers: Workers, progress: Callable[[float], None] = lambda share: None) -> CampaignResult:
    """Play everything. progress(share done) is called now and then."""
    everything: list[GripTrial | StableHold] = [*plan.trials, *plan.gone, *plan.tight, *plan.holds]
    items = sorted(everything, key=lambda item: not item.rendered)  # the dear ones first
    results = list(each(_play, items, workers, named=_named, progress=lambda done: progress(done / len(items))))
    played = sorted((one for one in results if isinstance(one, TrialOutcomes)), key=lambda one: one.trial.number)

    def block(name: Block, event: Event = "lifted") -> tuple[TrialOutcomes, ...]:
        return tuple(one for one in played if one.trial.block == name and one.trial.event == event)

    return CampaignResult(
        trials=block("matrix"),
        gone=block("matrix", "support gone"),
        high_need=block("high need"),
        fragile=block("fragile"),
        holds=tuple(one for one in results if isinstance(one, HoldOutcome)),
    )


def _play(item: GripTrial | StableHold) -> TrialOutcomes | HoldOutcome:
    if isinstance(item, StableHold):
        return hold(item)
    outcomes = {who: play(item, who) for who in CONTROLLER_NAMES}
    return TrialOutcomes(item, outcomes, play(item, "law", rendered=True) if item.rendered else None)


def _named(item: GripTrial | StableHold) -> str:
    return item.trial.name if isinstance(item, StableHold) else item.name
