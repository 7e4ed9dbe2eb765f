"""The whole campaign: every trial for everybody, some of them through rendered frames as well, and the stable holds."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, replace

from slipguard.lab.grip.holds import Held, Hold, hold, holds
from slipguard.lab.grip.matrix import Trial, trials
from slipguard.lab.grip.play import EVERYBODY, Outcome, Who, play
from slipguard.lab.parallel import Workers, each

QUICK_TRIALS, FULL_TRIALS = 32, None
QUICK_RENDERED, FULL_RENDERED = 20, 100
QUICK_GONE, FULL_GONE = 12, 144
"""Trials whose support goes away at once."""
QUICK_MINUTES, FULL_MINUTES = 3.0, 60.0
HOLD_S = 60.0
SUPPORT_GONE_NUMBERS = 5_000
TRIAL_CPU_S, RENDERED_CPU_S, HOLD_CPU_S = 0.45, 3.0, 2.8
"""What one of each costs on one core of a shared EPYC machine; a hold is a minute."""


@dataclass(frozen=True, slots=True)
class Plan:
    """What is to be played. minutes: of stable holds."""

    trials: tuple[Trial, ...]
    gone: tuple[Trial, ...]
    holds: tuple[Hold, ...]

    @classmethod
    def of(cls, *, quick: bool, seed: int = 0) -> Plan:
        """The quick plan, or all of the matrix. The same seed gives the same plan."""
        lifted = trials(QUICK_TRIALS if quick else FULL_TRIALS, QUICK_RENDERED if quick else FULL_RENDERED, seed)
        dropped = [
            replace(trial, event="support gone", number=SUPPORT_GONE_NUMBERS + trial.number)
            for trial in trials(QUICK_GONE if quick else FULL_GONE, 0, seed + 1)
        ]
        minutes = QUICK_MINUTES if quick else FULL_MINUTES
        return cls(tuple(lifted), tuple(dropped), tuple(holds(minutes, seed, HOLD_S)))

    @property
    def rendered(self) -> int:
        """Trials that go through rendered frames and the shipped network."""
        return sum(trial.rendered for trial in self.trials)

    def seconds(self, workers: Workers) -> float:
        """About how long it takes on this machine's cores."""
        cores = workers.jobs or os.cpu_count() or 1
        count = len(self.trials) + len(self.gone)
        return (TRIAL_CPU_S * count + RENDERED_CPU_S * self.rendered + HOLD_CPU_S * len(self.holds)) / cores


@dataclass(frozen=True, slots=True)
class Played:
    """One trial: how it went for everybody with the error model, and for the law through rendered frames."""

    trial: Trial
    outcomes: dict[Who, Outcome]
    rendered: Outcome | None = None

    @property
    def law(self) -> Outcome:
        """slipguard's outcome: with rendered frames where there is one."""
        return self.outcomes["law"] if self.rendered is None else self.rendered


@dataclass(frozen=True, slots=True)
class Found:
    """All that was played."""

    trials: tuple[Played, ...]
    gone: tuple[Played, ...]
    holds: tuple[Held, ...]


def run(plan: Plan, workers: Workers, progress: Callable[[float], None] = lambda share: None) -> Found:
    """Play everything. progress(share done) is called now and then."""
    dear_first = sorted(plan.trials, key=lambda trial: not trial.rendered)
    items: list[Trial | Hold] = [*dear_first, *plan.holds, *plan.gone]
    results = list(each(_play, items, workers, named=_named, progress=lambda done: progress(done / len(items))))
    played = [one for one in results if isinstance(one, Played)]
    return Found(
        trials=tuple(sorted((one for one in played if one.trial.event == "lifted"), key=lambda one: one.trial.number)),
        gone=tuple(one for one in played if one.trial.event != "lifted"),
        holds=tuple(one for one in results if isinstance(one, Held)),
    )


def _play(item: Trial | Hold) -> Played | Held:
    if isinstance(item, Hold):
        return hold(item)
    outcomes = {who: play(item, who) for who in EVERYBODY}
    return Played(item, outcomes, play(item, "law", rendered=True) if item.rendered else None)


def _named(item: Trial | Hold) -> str:
    return item.trial.name if isinstance(item, Hold) else item.name
