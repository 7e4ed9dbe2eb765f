"""`slipguard bench --grip`: the grip law's campaign with its progress, tables, picture and exit code."""

from __future__ import annotations

import json as jsonlib
from pathlib import Path
from typing import TYPE_CHECKING

import typer

if TYPE_CHECKING:
    from slipguard.tools.parallel import Workers


def bench_grip(*, quick: bool, seed: int, json: bool, out: Path | None, workers: Workers) -> None:
    """Play the campaign; exit code 1 if anything that is promised of it is not kept."""
    from rich.console import Console

    from slipguard.bench.grip.campaign import Plan, run
    from slipguard.bench.grip.checks import checks, failures
    from slipguard.bench.grip.figures import as_json, scenarios
    from slipguard.bench.grip.report import draw, print_tables
    from slipguard.cli.progress import progress_bar

    plan = Plan.of(quick=quick, seed=seed)
    progress = Console(stderr=True)
    progress.print(
        f"{len(plan.trials)} lifts gripped too weakly ({plan.rendered} of them through rendered frames), "
        f"{len(plan.gone)} losses of support, {len(plan.tight)} needs close to the budget, "
        f"{sum(one.seconds for one in plan.holds) / 60.0:.0f} minutes of stable holds: about "
        f"{_spoken(plan.seconds(workers))}",
        highlight=False,
    )
    with progress_bar("grip campaign") as show:
        found = run(plan, workers, lambda share: show("grip campaign", share))
    figures = as_json(found)
    figures["promised"] = [check.as_json() for check in checks(figures)]
    if out is not None:
        draw(found, out / "grip.png")
        (out / "grip.json").write_text(jsonlib.dumps(figures | scenarios(found), indent=2) + "\n", encoding="utf-8")
    if json:
        print(jsonlib.dumps(figures))
    else:
        print_tables(Console(highlight=False), found)
    failed = failures(figures)
    for line in failed:
        progress.print(line, style="red", highlight=False)
    if failed:
        raise typer.Exit(1)


def _spoken(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 100.0 else f"{seconds / 60.0:.0f} minutes"
