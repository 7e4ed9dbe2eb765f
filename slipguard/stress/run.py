"""`slipguard stress`: the perturbations in turn for a limited time, and the figures of their trials."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any

from slipguard.errors import InputError
from slipguard.stress.perturbations import PERTURBATIONS
from slipguard.stress.trial import FailureKind, ProductFunctions, TrialOutcome, run_trial
from slipguard.tools.experiment import Case, run_cases
from slipguard.tools.figures import plain
from slipguard.tools.parallel import Workers

StressCase = Case[ProductFunctions]
MIN_JUDGED = 60
"""From this many possible estimates on, the share of answered ones is checked."""
KINDS: tuple[FailureKind, ...] = ("crash", "nan", "confident wrong", "limit")
SUMMARY = ("tried", "share", "crashes", "nan", "confident_wrong", "worst", "drift_deg", "broken_at")
"""Keys of `as_json` that `--json` prints; `stress.json` in the --out folder contains all of them."""


@dataclass(frozen=True, slots=True)
class TrialFailure:
    """One failed check; `command` reproduces it."""

    name: str
    kind: FailureKind
    seed: int
    what: str

    @property
    def command(self) -> str:
        return f'slipguard stress --only "{self.name}" --seed {self.seed} --seconds 0.001'


@dataclass(frozen=True, slots=True)
class PerturbationFigures:
    """The trials of one perturbation."""

    name: str
    trials: Sequence[tuple[StressCase, TrialOutcome]]

    def errors(self) -> list[tuple[float, float]]:
        """Return (absolute error, sigma) in degrees of all trials."""
        return [error for _, outcome in self.trials for error in outcome.errors]

    @property
    def estimated(self) -> int:
        return sum(outcome.estimated for _, outcome in self.trials)

    @property
    def declined(self) -> int:
        return sum(outcome.declined for _, outcome in self.trials)

    @property
    def worst_deg(self) -> float | None:
        return max((error for error, _ in self.errors()), default=None)

    @property
    def worst_sigmas(self) -> float | None:
        return max((error / sigma for error, sigma in self.errors()), default=None)

    @property
    def drift_deg(self) -> float | None:
        known = [outcome.drift_deg for _, outcome in self.trials if outcome.drift_deg is not None]
        return max(known, default=None)

    @property
    def broken_at(self) -> float | None:
        """The smallest level of a sweep at which an estimate was off by more than 4 sigma."""
        broken = [outcome.level for _, outcome in self.trials if outcome.broken]
        return min(broken, default=None) if PERTURBATIONS[self.name].sweep else None

    @property
    def failures(self) -> list[TrialFailure]:
        found = [
            TrialFailure(self.name, kind, case.seed, what)
            for case, outcome in self.trials
            for kind, what in outcome.failures
        ]
        possible, least = self.estimated + self.declined, PERTURBATIONS[self.name].least_answered
        if possible >= MIN_JUDGED and self.estimated < least * possible:
            what = f"estimated {self.estimated:,} of {possible:,}, the minimum is {least:.0%}"
            found.append(TrialFailure(self.name, "limit", self.trials[0][0].seed, what))
        return found

    def count(self, kind: FailureKind) -> int:
        return sum(failure.kind == kind for failure in self.failures)

    def as_json(self) -> dict[str, Any]:
        return {
            "tried": len(self.trials),
            "full": PERTURBATIONS[self.name].trials,
            "least_told": PERTURBATIONS[self.name].least_answered,
            "answers": self.estimated,
            "declined": self.declined,
            "failures": {kind: count for kind in KINDS if (count := self.count(kind))},
            "worst_deg": self.worst_deg,
            "worst_sigmas": self.worst_sigmas,
            "broken_at": self.broken_at,
        }


@dataclass(frozen=True, slots=True)
class StressRun:
    """The result of a run; it failed if any check did."""

    seed: int
    spent_s: float
    perturbations: Mapping[str, PerturbationFigures]

    @property
    def failures(self) -> list[TrialFailure]:
        return [failure for one in self.perturbations.values() for failure in one.failures]

    @property
    def tried(self) -> int:
        return sum(len(one.trials) for one in self.perturbations.values())

    @property
    def share(self) -> float:
        """Share of the full list."""
        return self.tried / sum(PERTURBATIONS[name].trials for name in self.perturbations)

    @property
    def first_failures(self) -> list[TrialFailure]:
        """The first failure of each kind of each perturbation."""
        return list({(one.name, one.kind): one for one in reversed(self.failures)}.values())[::-1]

    @property
    def broken_at(self) -> dict[str, float]:
        found = {name: one.broken_at for name, one in sorted(self.perturbations.items())}
        return {name: level for name, level in found.items() if level is not None}

    def as_json(self) -> dict[str, Any]:
        """Return all results; errors in degrees, null where nothing was measured.

        worst: the largest error, regardless of its sigma. broken_at: see `PerturbationFigures.broken_at`.
        """
        counts = {kind: sum(one.count(kind) for one in self.perturbations.values()) for kind in KINDS}
        drifts = [one.drift_deg for one in self.perturbations.values() if one.drift_deg is not None]
        found = {
            "tried": self.tried,
            "share": self.share,
            "crashes": counts["crash"],
            "nan": counts["nan"],
            "confident_wrong": counts["confident wrong"],
            "broken_promises": counts["limit"],
            "worst": {name: one.worst_deg or 0.0 for name, one in self.perturbations.items()},
            "drift_deg": max(drifts, default=None),
            "broken_at": self.broken_at,
            "seed": self.seed,
            "spent_s": self.spent_s,
            "families": {name: one.as_json() for name, one in self.perturbations.items()},
            "failures": [
                {"family": one.name, "kind": one.kind, "seed": one.seed, "what": one.what, "again": one.command}
                for one in self.first_failures
            ],
        }
        return dict(plain(found))


def cases(names: Iterable[str], seed: int, product: ProductFunctions) -> list[StressCase]:
    """Return the full list: the perturbations in turn; trial k of each has the seed `seed + k`.

    Raises InputError for an unknown name; the message lists the known ones. No name stands for all.
    """
    chosen = list(dict.fromkeys(names)) or list(PERTURBATIONS)
    for name in chosen:
        if name not in PERTURBATIONS:
            raise InputError(f"--only {name}: unknown perturbation. Choose from {', '.join(PERTURBATIONS)}")
    rounds = max(PERTURBATIONS[name].trials for name in chosen)
    return list(
        chain.from_iterable(
            (Case(name, seed + k, product) for name in chosen if k < PERTURBATIONS[name].trials) for k in range(rounds)
        )
    )


def run(
    names: Sequence[str],
    seed: int,
    seconds: float = math.inf,
    product: ProductFunctions | None = None,
    workers: Workers | None = None,
    progress: Callable[[float], None] = lambda share: None,
    clock: Callable[[], float] = time.perf_counter,
) -> StressRun:
    """Run the list from its start for `seconds`, each perturbation at least once."""
    planned = cases(names, seed, product or ProductFunctions())
    found: dict[str, list[tuple[StressCase, TrialOutcome]]] = {case.name: [] for case in planned}
    began_s = clock()
    for case, outcome in run_cases(
        run_trial, planned, workers, progress=progress, seconds=seconds, at_least=len(found), clock=clock
    ):
        found[case.name].append((case, outcome))
    figures = {name: PerturbationFigures(name, trials) for name, trials in found.items()}
    return StressRun(seed, clock() - began_s, figures)
