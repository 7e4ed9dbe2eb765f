"""`slipguard bench --grip`: the grip law's campaign with its progress, tables, picture and exit code."""

from __future__ import annotations

import json as jsonlib
from pathlib import Path
from typing import TYPE_CHECKING

import typer

if TYPE_CHECKING:
    from slipguard.lab.parallel import Workers


def bench_grip(*, quick: bool, seed: int, json: bool, out: Path | None, workers: Workers) -> None:
    """Play the campaign; exit code 1 if an object was dropped that could have been held, or gripped for nothing."""
    from rich.console import Console

    from slipguard.cli.progress import progress_bar
    from slipguard.lab.grip.campaign import Plan, run
    from slipguard.lab.grip.figures import as_json, failures
    from slipguard.lab.grip.report import draw, print_tables

    plan = Plan.of(quick=quick, seed=seed)
    progress = Console(stderr=True)
    progress.print(
        f"{len(plan.trials)} lifts gripped too weakly ({plan.rendered} of them through rendered frames), "
        f"{len(plan.gone)} losses of support, {len(plan.holds)} minutes of stable holds: about "
        f"{_spoken(plan.seconds(workers))}",
        highlight=False,
    )
    with progress_bar("grip campaign") as show:
        found = run(plan, workers, lambda share: show("grip campaign", share))
    figures = as_json(found)
    if out is not None:
        draw(found, out / "grip.png")
        (out / "grip.json").write_text(jsonlib.dumps(figures, indent=2) + "\n", encoding="utf-8")
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
