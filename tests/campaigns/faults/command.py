"""`python -m tests.campaigns faults`: the whole daemon on virtual time, with injected faults."""

from __future__ import annotations

import json as jsonlib
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from slipguard.cli.terminal import count_bar
from slipguard.tools.parallel import Workers
from tests.campaigns.faults.campaign import CampaignResult, FaultTally, quiet_trial, run_campaign
from tests.campaigns.faults.trial import TrialResult

SHOWN = 10
"""Failed runs shown in full; the others by their seed."""


def faults(
    runs: Annotated[int, typer.Option(min=1, help="Number of runs with one to three faults each; 1 prints its log.")],
    seed: Annotated[int, typer.Option(help="Seed of the first run; the same seed gives the same run.")] = 0,
    jobs: Annotated[int, typer.Option(help="Processes; 0: one per core.")] = 0,
    cluster: Annotated[str | None, typer.Option(help="Dask scheduler: tcp://HOST:8786.")] = None,
    json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
    out: Annotated[Path | None, typer.Option(help="Folder for faults.json.")] = None,
) -> None:
    """Run the daemon on virtual time with one to three faults per run; exit 1 if a safety rule was broken.

    Example: `python -m tests.campaigns faults --runs 1000`
    """
    console = Console(stderr=json)
    if runs == 1:
        result = quiet_trial(seed)
        found = CampaignResult()
        found.count(result)
        _print_run(console, result)
    else:
        with count_bar("runs with faults", runs) as show:
            found = run_campaign(runs, seed, Workers(jobs, cluster), show)
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        (out / "faults.json").write_text(jsonlib.dumps(found.as_json(), indent=2) + "\n", encoding="utf-8")
    if json:
        print(jsonlib.dumps(found.as_json()))
    else:
        _print(console, found)
    if found.failures:
        raise typer.Exit(1)


def _print(console: Console, found: CampaignResult) -> None:
    head = Table(title=f"{found.runs} runs with one to three faults each")
    for name in ("avoidable drops", "openings", "presses", "unnamed faults", "crashes", "leaked tasks"):
        head.add_column(name, justify="right")
    safe = (found.drops_avoidable, found.openings, found.presses)
    counts = (*safe, found.unnamed_faults, found.crashes, found.leaked_tasks)
    head.add_row(*(str(count) for count in counts))
    console.print(head)
    kinds = Table(title="time until the log names the fault, from when it is observable")
    for name in ("fault", "runs", "observable", "median", "longest", "not in time"):
        kinds.add_column(name, justify="left" if name == "fault" else "right")
    for name, tally in found.kinds.items():
        kinds.add_row(name, str(tally.runs), str(tally.due), *_times(tally), str(tally.unnamed or ""))
    console.print(kinds)
    if found.drops > found.drops_avoidable:
        console.print(f"{found.drops - found.drops_avoidable} further drops were unavoidable", style="dim")
    for result in found.failures[:SHOWN]:
        console.print(f"failed: {describe(result)}", style="red", highlight=False)
    if len(found.failures) > SHOWN:
        rest = ", ".join(str(result.seed) for result in found.failures[SHOWN:])
        console.print(f"failed as well: seeds {rest}", style="red", highlight=False)
    if found.failures:
        console.print(f"repeat one: python -m tests.campaigns faults --runs 1 --seed {found.failures[0].seed}")


def describe(result: TrialResult) -> str:
    """Return one line about a failed run."""
    what = [
        f"dropped ({result.dropped})" if result.avoidable else "",
        f"{result.openings} openings" if result.openings else "",
        f"pressed harder during a stop of the arm, {result.presses} times" if result.presses else "",
        f"not named: {', '.join(result.unnamed)}" if result.unnamed else "",
        *result.crashes,
        f"tasks left: {', '.join(result.leaked)}" if result.leaked else "",
    ]
    plans = "; ".join(str(plan) for plan in result.plans)
    return f"seed {result.seed} ({result.object_name}; {plans}): {'; '.join(part for part in what if part)}"


def _print_run(console: Console, result: TrialResult) -> None:
    console.print(f"seed {result.seed}: {result.object_name}; " + "; ".join(str(plan) for plan in result.plans))
    for line in result.lines:
        console.print(line, highlight=False, markup=False)
    if result.dropped is not None:
        console.print(f"dropped: {result.dropped}")


def _times(tally: FaultTally) -> Sequence[str]:
    if not tally.named_s:
        return "", ""
    in_order = sorted(tally.named_s)
    return f"{in_order[len(in_order) // 2]:.2f} s", f"{in_order[-1]:.2f} s"
