"""Many runs with faults and their totals."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, field

import structlog

from slipguard.tools.parallel import Workers, each
from tests.campaigns.faults.kinds import KINDS
from tests.campaigns.faults.trial import TrialResult, trial


@dataclass(slots=True)
class FaultTally:
    """One fault in all runs. runs: with it; due: where it was observable; named_s: times until the log named it."""

    runs: int = 0
    due: int = 0
    unnamed: int = 0
    named_s: list[float] = field(default_factory=list)

    def as_json(self) -> dict[str, object]:
        """Return the JSON form."""
        in_order = sorted(self.named_s)
        return {
            "runs": self.runs,
            "observable": self.due,
            "unnamed": self.unnamed,
            "named_s_median": round(in_order[len(in_order) // 2], 3) if in_order else None,
            "named_s_max": round(in_order[-1], 3) if in_order else None,
        }


@dataclass(slots=True)
class CampaignResult:
    """Totals of all runs. failures: the runs in which a safety rule was broken."""

    runs: int = 0
    drops: int = 0
    drops_avoidable: int = 0
    openings: int = 0
    presses: int = 0
    unnamed_faults: int = 0
    crashes: int = 0
    leaked_tasks: int = 0
    kinds: dict[str, FaultTally] = field(default_factory=lambda: {name: FaultTally() for name in KINDS})
    failures: list[TrialResult] = field(default_factory=list)

    def count(self, result: TrialResult) -> None:
        """Add one run."""
        self.runs += 1
        self.drops += result.dropped is not None
        self.drops_avoidable += result.avoidable
        self.openings += result.openings
        self.presses += result.presses
        self.unnamed_faults += len(result.unnamed)
        self.crashes += len(result.crashes)
        self.leaked_tasks += len(result.leaked)
        for plan in result.plans:
            self.kinds[plan.kind.name].runs += 1
        for name in result.due:
            self.kinds[name].due += 1
        for name in result.unnamed:
            self.kinds[name].unnamed += 1
        for name, after_s in result.named:
            self.kinds[name].named_s.append(after_s)
        if result.failed:
            self.failures.append(result)

    def as_json(self) -> dict[str, object]:
        """Return the JSON form; failed runs by seed."""
        return {
            "runs": self.runs,
            "drops_avoidable": self.drops_avoidable,
            "openings": self.openings,
            "presses_near_a_person": self.presses,
            "unnamed_faults": self.unnamed_faults,
            "crashes": self.crashes,
            "leaked_tasks": self.leaked_tasks,
            "drops": self.drops,
            "failed_seeds": [result.seed for result in self.failures],
            "kinds": {name: tally.as_json() for name, tally in self.kinds.items()},
        }


def run_campaign(
    runs: int, seed: int, workers: Workers | None = None, progress: Callable[[int], None] = lambda done: None
) -> CampaignResult:
    """Run the seeds `seed` to `seed + runs - 1`."""
    found = CampaignResult()
    for result in each(quiet_trial, range(seed, seed + runs), workers, named=_named, progress=progress):
        found.count(result)
    return found


def quiet_trial(seed: int) -> TrialResult:
    """Return one run without printing its log."""
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.CRITICAL))
    try:
        return trial(seed)
    finally:
        structlog.reset_defaults()


def _named(seed: int) -> str:
    return f"run {seed}"
