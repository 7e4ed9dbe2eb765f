"""`python -m tests.campaigns faults`: the whole daemon on virtual time, with injected faults, many times."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from statistics import median
from typing import Annotated

import structlog
import typer

from slipguard.cli.terminal import count_bar
from slipguard.tools.parallel import Workers, each
from tests.campaigns.faults.kinds import KINDS
from tests.campaigns.faults.trial import TrialResult, trial
from tests.campaigns.figures import Figure, report


def faults(
    runs: Annotated[int, typer.Option(min=1, help="Number of runs with one to three faults each; 1 prints its log.")],
    seed: Annotated[int, typer.Option(help="Seed of the first run; the same seed gives the same run.")] = 0,
    jobs: Annotated[int, typer.Option(help="Processes; 0: one per core.")] = 0,
    json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Run the daemon on virtual time with one to three faults per run; exit 1 if a safety rule was broken.

    Example: `python -m tests.campaigns faults --runs 1000`
    """
    if runs == 1:
        results = [quiet_trial(seed)]
        if not json:
            print(*results[0].lines, sep="\n")
    else:
        with count_bar("runs with faults", runs) as show:
            results = list(each(quiet_trial, range(seed, seed + runs), Workers(jobs), named=_named, progress=show))
    failed = [describe(result) for result in results if result.failed]
    report(figures(results), {"faults": times(results), "failed": failed}, json)


def quiet_trial(seed: int) -> TrialResult:
    """Return one run without printing its log."""
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.CRITICAL))
    try:
        return trial(seed)
    finally:
        structlog.reset_defaults()


def figures(results: Sequence[TrialResult]) -> list[Figure]:
    """Return the totals of all runs; each has the limit 0 but for drops that nothing could prevent."""
    return [
        Figure("runs", len(results), 1, at_least=True),
        Figure("avoidable drops", sum(one.avoidable for one in results)),
        Figure("openings", sum(one.openings for one in results)),
        Figure("forces added near a person", sum(one.presses for one in results)),
        Figure("unnamed faults", sum(len(one.unnamed) for one in results)),
        Figure("crashes", sum(len(one.crashes) for one in results)),
        Figure("leaked tasks", sum(len(one.leaked) for one in results)),
        Figure("drops", sum(one.dropped is not None for one in results), limit=None),
    ]


def times(results: Sequence[TrialResult]) -> dict[str, dict[str, float]]:
    """Return by fault: how often it was observable, and the time until the log named it, from then on."""
    found = {}
    for name in KINDS:
        named_s = [after_s for one in results for kind, after_s in one.named if kind == name]
        found[name] = {"observable": float(sum(name in one.due for one in results))}
        if named_s:
            found[name] |= {"named_s_median": round(median(named_s), 3), "named_s_max": round(max(named_s), 3)}
    return found


def describe(result: TrialResult) -> str:
    """Return one line about a failed run."""
    what = [
        f"dropped ({result.dropped})" if result.avoidable else "",
        f"{result.openings} openings" if result.openings else "",
        f"force added during a stop of the arm, {result.presses} times" if result.presses else "",
        f"not named: {', '.join(result.unnamed)}" if result.unnamed else "",
        *result.crashes,
        f"tasks left: {', '.join(result.leaked)}" if result.leaked else "",
    ]
    plans = "; ".join(str(plan) for plan in result.plans)
    return f"seed {result.seed} ({result.object_name}; {plans}): {'; '.join(part for part in what if part)}"


def _named(seed: int) -> str:
    return f"run {seed}"
