"""Many runs with faults, and what they come to."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, field

import structlog

from slipguard.tools.parallel import Workers, each
from tests.campaigns.faults.kinds import KINDS
from tests.campaigns.faults.trial import TrialResult, trial


@dataclass(slots=True)
class KindTally:
    """One kind in all runs. runs: with it; due: where it could be seen; named_s: how long each took to be named."""

    runs: int = 0
    due: int = 0
    unnamed: int = 0
    named_s: list[float] = field(default_factory=list)

    def as_json(self) -> dict[str, object]:
        """The same in figures."""
        in_order = sorted(self.named_s)
        return {
            "runs": self.runs,
            "could_be_seen": self.due,
            "unnamed": self.unnamed,
            "named_s_median": round(in_order[len(in_order) // 2], 3) if in_order else None,
            "named_s_max": round(in_order[-1], 3) if in_order else None,
        }


@dataclass(slots=True)
class Campaign:
    """What all runs came to. failures: the runs in which anything happened that must not."""

    runs: int = 0
    drops: int = 0
    drops_avoidable: int = 0
    openings: int = 0
    presses: int = 0
    unnamed_faults: int = 0
    crashes: int = 0
    leaked_tasks: int = 0
    kinds: dict[str, KindTally] = field(default_factory=lambda: {name: KindTally() for name in KINDS})
    failures: list[TrialResult] = field(default_factory=list)

    def count(self, outcome: TrialResult) -> None:
        """One run more."""
        self.runs += 1
        self.drops += outcome.dropped is not None
        self.drops_avoidable += outcome.avoidable
        self.openings += outcome.openings
        self.presses += outcome.presses
        self.unnamed_faults += len(outcome.unnamed)
        self.crashes += len(outcome.crashes)
        self.leaked_tasks += len(outcome.leaked)
        for plan in outcome.plans:
            self.kinds[plan.kind.name].runs += 1
        for name in outcome.due:
            self.kinds[name].due += 1
        for name in outcome.unnamed:
            self.kinds[name].unnamed += 1
        for name, after_s in outcome.named:
            self.kinds[name].named_s.append(after_s)
        if outcome.failed:
            self.failures.append(outcome)

    def as_json(self) -> dict[str, object]:
        """The figures; the failed runs by seed."""
        return {
            "runs": self.runs,
            "drops_avoidable": self.drops_avoidable,
            "openings": self.openings,
            "presses_near_a_person": self.presses,
            "unnamed_faults": self.unnamed_faults,
            "crashes": self.crashes,
            "leaked_tasks": self.leaked_tasks,
            "drops": self.drops,
            "failed_seeds": [outcome.seed for outcome in self.failures],
            "kinds": {name: tally.as_json() for name, tally in self.kinds.items()},
        }


def campaign(
    runs: int, seed: int, workers: Workers | None = None, progress: Callable[[int], None] = lambda done: None
) -> Campaign:
    """Runs `seed` to `seed + runs - 1`."""
    found = Campaign()
    for outcome in each(quiet_trial, range(seed, seed + runs), workers, named=_named, progress=progress):
        found.count(outcome)
    return found


def quiet_trial(seed: int) -> TrialResult:
    """One run whose log is looked at, not printed."""
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.CRITICAL))
    try:
        return trial(seed)
    finally:
        structlog.reset_defaults()


def _named(seed: int) -> str:
    return f"run {seed}"
