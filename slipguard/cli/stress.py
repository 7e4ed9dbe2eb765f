"""`slipguard stress`: numerical stability, from degenerate masks to a million tracked frames."""

from __future__ import annotations

import json as jsonlib
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from slipguard.atomic_file import write_atomically
from slipguard.cli.terminal import make_folder, progress_bar
from slipguard.errors import InputError

if TYPE_CHECKING:
    from slipguard.stress.runner import StressOutcome

PLOT = "error-against-noise.png"


def stress(
    seconds: Annotated[
        float, typer.Option(min=0.0, help="Duration; 0 runs the full list, after printing how long it takes.")
    ] = 60.0,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the random numbers; trial k uses this plus k.")] = 0,
    only: Annotated[list[str] | None, typer.Option(help="Run only this family of trials; may be repeated.")] = None,
    json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
    out: Annotated[Path | None, typer.Option(help=f"Folder for {PLOT} and stress.json.")] = None,
    jobs: Annotated[int, typer.Option(min=0, help="Processes for the full list; 0: one per core.")] = 0,
    cluster: Annotated[str | None, typer.Option(help="Dask scheduler for the full list: tcp://HOST:8786.")] = None,
) -> None:
    """Test the estimators with hard inputs: degenerate masks, noise, nearly round contacts, NaN, odd clocks.

    Exits 1 if an estimator crashed, returned NaN, was confidently wrong (error above 5 sigma and 3 degrees) or exceeded
    a specified limit. The full list uses all cores. stress.json in the --out folder is updated while it runs, so that
    it contains the results of an interrupted run.

    Example: `slipguard stress --seconds 60 --out stress/`, `slipguard stress --only noise --seed 136 --seconds 1`,
    `slipguard stress --seconds 0 --out stress/`
    """
    from rich.console import Console

    from slipguard.stress.report import as_json, draw, print_table, summary
    from slipguard.stress.runner import full_hours, run, run_full_list, select_families
    from slipguard.tools.parallel import Workers

    families = select_families(only or [])
    workers = Workers(jobs, cluster)
    make_folder(out)
    progress = Console(stderr=True)

    def save(outcome: StressOutcome) -> None:
        if out is not None:
            _write(out / "stress.json", jsonlib.dumps(as_json(outcome), indent=1) + "\n")

    with progress_bar("stress") as show:
        if seconds == 0.0:
            progress.print(f"the full list takes about {full_hours(families):.2g} h on one core")
            batches = run_full_list(families, seed, None, workers, lambda share, family: show(family, share))
            for outcome in batches:
                save(outcome)
        else:
            outcome = run(families, seed, seconds, progress=lambda share, family: show(family, share))
    if json:
        print(jsonlib.dumps(summary(outcome)))
    else:
        print_table(Console(), outcome)
    save(outcome)
    if out is not None:
        draw(outcome, out / PLOT)
        progress.print(f"plot: {out / PLOT}")
    if outcome.failed:
        raise typer.Exit(1)


def _write(path: Path, text: str) -> None:
    try:
        write_atomically(path, text.encode(), 0o644)
    except OSError as error:
        raise InputError(f"{path}: cannot write the file: {error}") from error
