"""The full list of `slipguard stress`, in parallel: hours on all cores."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from slipguard.stress.report import PLOT, draw, print_table
from slipguard.stress.run import run
from slipguard.tools.figures import write_json
from slipguard.tools.parallel import Workers


def stress_list(
    out: Annotated[Path, typer.Option(help=f"Folder for {PLOT} and stress.json.")],
    seed: Annotated[int, typer.Option(min=0, help="Seed of the random numbers; trial k uses this plus k.")] = 0,
    only: Annotated[list[str] | None, typer.Option(help="Apply only this perturbation; may be repeated.")] = None,
    jobs: Annotated[int, typer.Option(min=0, help="Processes; 0: one per core.")] = 0,
    cluster: Annotated[str | None, typer.Option(help="Dask scheduler: tcp://HOST:8786.")] = None,
) -> None:
    """Run the full list of `slipguard stress`; exits 1 if a check failed.

    Example: `python -m tests.campaigns stress-list --out stress/`
    """
    out.mkdir(parents=True, exist_ok=True)
    found = run(only or [], seed, workers=Workers(jobs, cluster))
    write_json(out / "stress.json", found.as_json())
    draw(found, out / PLOT)
    print_table(Console(), found)
    if found.failures:
        raise typer.Exit(1)
