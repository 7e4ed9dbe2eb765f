"""`slipguard stress`: numerical stability, from degenerate masks to a million tracked frames."""

from __future__ import annotations

import json as jsonlib
from pathlib import Path
from typing import Annotated

import typer

from slipguard.cli.options import JsonOption
from slipguard.cli.terminal import make_folder, progress_bar


def stress(
    seconds: Annotated[float, typer.Option(min=0.001, help="Duration.")] = 60.0,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the random numbers; trial k uses this plus k.")] = 0,
    only: Annotated[list[str] | None, typer.Option(help="Run only this family of trials; may be repeated.")] = None,
    json: JsonOption = False,
    out: Annotated[Path | None, typer.Option(help="Folder for a plot and stress.json.")] = None,
) -> None:
    """Test the estimators with hard inputs: degenerate masks, noise, nearly round contacts, NaN, odd clocks.

    Exits 1 if an estimator crashed, returned NaN, was confidently wrong (pipeline above 4 sigma) or exceeded
    a specified limit. The family `effects` is swept until estimates are confidently wrong: it reports from which
    size of an effect on, and that is no failure.

    Example: `slipguard stress --seconds 60 --out stress/`, `slipguard stress --only noise --seed 136 --seconds 1`
    """
    from rich.console import Console

    from slipguard.stress.report import PLOT, as_json, draw, print_table, summary
    from slipguard.stress.runner import run, select_families

    families = select_families(only or [])
    make_folder(out)
    with progress_bar("stress") as show:
        outcome = run(families, seed, seconds, progress=lambda share, family: show(family, share))
    if json:
        print(jsonlib.dumps(summary(outcome)))
    else:
        print_table(Console(), outcome)
    if out is not None:
        (out / "stress.json").write_text(jsonlib.dumps(as_json(outcome), indent=1) + "\n", encoding="utf-8")
        draw(outcome, out / PLOT)
        Console(stderr=True).print(f"plot: {out / PLOT}")
    if outcome.failed:
        raise typer.Exit(1)
