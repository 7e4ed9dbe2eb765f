"""The full list of `slipguard stress`, in parallel batches: hours on all cores."""

from __future__ import annotations

import json as jsonlib
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console

from slipguard.atomic_file import write_atomically
from slipguard.stress.product_functions import ProductFunctions
from slipguard.stress.report import PLOT, as_json, draw, print_table
from slipguard.stress.runner import StressOutcome, full_hours, run_trial, select_families
from slipguard.stress.trial_family import KEPT_FAILURES, CurvePoint, FamilyResults, TrialFamily
from slipguard.tools.parallel import Workers, each

BATCH_MS = 10_000.0
"""Estimated time of one batch: short, so that all cores stay busy to the end and an interrupt loses little."""


def stress_list(
    out: Annotated[Path, typer.Option(help=f"Folder for {PLOT} and stress.json, which is updated while it runs.")],
    seed: Annotated[int, typer.Option(min=0, help="Seed of the random numbers; trial k uses this plus k.")] = 0,
    only: Annotated[list[str] | None, typer.Option(help="Run only this family of trials; may be repeated.")] = None,
    jobs: Annotated[int, typer.Option(min=0, help="Processes; 0: one per core.")] = 0,
    cluster: Annotated[str | None, typer.Option(help="Dask scheduler: tcp://HOST:8786.")] = None,
) -> None:
    """Run the full list of `slipguard stress`; exits 1 if a check failed.

    Example: `python -m tests.campaigns stress-list --out stress/`
    """
    families = select_families(only or [])
    out.mkdir(parents=True, exist_ok=True)
    console = Console()
    console.print(f"the full list takes about {full_hours(families):.2g} h on one core")
    for outcome in run_full_list(families, seed, None, Workers(jobs, cluster)):
        write_atomically(out / "stress.json", (jsonlib.dumps(as_json(outcome), indent=1) + "\n").encode(), 0o644)
    print_table(console, outcome)
    draw(outcome, out / PLOT)
    if outcome.failed:
        raise typer.Exit(1)


@dataclass(frozen=True, slots=True)
class TrialBatch:
    """Trials `first` to `after - 1` of a family."""

    family: TrialFamily
    first: int
    after: int

    def __str__(self) -> str:
        return f"{self.family.name}, trials {self.first} to {self.after - 1}"


def batches(families: Sequence[TrialFamily]) -> list[TrialBatch]:
    """Split the full list into batches, ordered so that all families progress alike; a continuous one is not split."""
    found: list[TrialBatch] = []
    for family in families:
        size = family.full if family.continuous else max(1, round(BATCH_MS / family.cost_ms))
        found += [TrialBatch(family, first, min(first + size, family.full)) for first in range(0, family.full, size)]
    return sorted(found, key=lambda batch: batch.first / batch.family.full)


def run_full_list(
    families: Sequence[TrialFamily],
    seed: int,
    product: ProductFunctions | None = None,
    workers: Workers | None = None,
    progress: Callable[[float, str], None] = lambda share, name: None,
    clock: Callable[[], float] = time.perf_counter,
) -> Iterator[StressOutcome]:
    """Run the full list in batches; yield the results so far after each batch, and so finally all of them.

    Trial k of a family has the seed `seed + k`, in whichever process it runs. progress: called with the share done and
    the family's name.
    """
    started_s = clock()
    found = {family.name: FamilyResults(family.name) for family in families}
    split = batches(families)
    total_ms = sum(family.full * family.cost_ms for family in families)
    done_ms = 0.0
    for batch, results in zip(split, each(partial(_run_batch, seed, product), split, workers), strict=True):
        merge(found[batch.family.name], results)
        done_ms += (batch.after - batch.first) * batch.family.cost_ms
        progress(done_ms / total_ms, batch.family.name)
        yield StressOutcome(seed, clock() - started_s, tuple(families), tuple(found.values()))


def _run_batch(seed: int, product: ProductFunctions | None, batch: TrialBatch) -> FamilyResults:
    results = FamilyResults(batch.family.name)
    with np.errstate(all="ignore"):  # as in `run`
        trial = batch.family.begin(ProductFunctions() if product is None else product)
        for number in range(batch.first, batch.after):
            run_trial(batch.family, trial, seed, number, results)
    return results


def merge(results: FamilyResults, later: FamilyResults) -> None:
    """Add the results of later trials of the same family."""
    results.tried += later.tried
    results.estimated += later.estimated
    results.declined += later.declined
    both = [*results.failures, *later.failures]
    firsts = {one.kind: one for one in reversed(both)}
    results.failures = [one for k, one in enumerate(both) if k < KEPT_FAILURES or one is firsts[one.kind]]
    results.counts += later.counts
    for mine, others in (
        (results.worst_deg, later.worst_deg),
        (results.worst_sigmas, later.worst_sigmas),
        (results.largest, later.largest),
    ):
        for what, value in others.items():
            mine[what] = max(mine.get(what, value), value)
    for effect, level in later.broken_at.items():
        results.broken_at[effect] = min(results.broken_at.get(effect, level), level)
    for curve, levels in later.curves.items():
        for level, added in levels.items():
            point = results.curves.setdefault(curve, {}).setdefault(level, CurvePoint())
            point.errors_deg += added.errors_deg
            point.declined += added.declined
