"""`slipguard stress`: numerical stability, from degenerate masks to a million tracked frames."""

from __future__ import annotations

import json as jsonlib
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from slipguard.atomic_file import write_whole
from slipguard.cli.progress import progress_bar
from slipguard.errors import InputError

if TYPE_CHECKING:
    from slipguard.stress.runner import StressOutcome
    from slipguard.stress.trial_family import TrialFamily
    from slipguard.tools.parallel import Workers

PICTURE = "error-against-noise.png"


def stress(
    seconds: Annotated[
        float, typer.Option(min=0.0, help="Time to spend; 0 runs the full list, which says how long it takes.")
    ] = 60.0,
    seed: Annotated[int, typer.Option(min=0, help="Seed of all that is random; trial k has this plus k.")] = 0,
    only: Annotated[
        list[str] | None, typer.Option(help="Only this family of trials; may be given several times.")
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="One JSON object.")] = False,
    out: Annotated[Path | None, typer.Option(help=f"Folder for {PICTURE} and stress.json.")] = None,
    jobs: Annotated[int, typer.Option(min=0, help="Processes for the full list; 0: one for each core.")] = 0,
    cluster: Annotated[str | None, typer.Option(help="Dask scheduler for the full list: tcp://HOST:8786.")] = None,
) -> None:
    """Try what breaks estimators: degenerate masks, noise, seams, circles, reliefs, bad numbers, odd clocks, light.

    Exit code 1 where anything crashed, gave NaN, was confidently wrong (more than 5 sigma and 3 degrees) or broke a
    promise. The full list runs on all cores; stress.json in the --out folder grows with it, and is what an interrupted
    run has found.

    Example: `slipguard stress --seconds 60 --out stress/`, `slipguard stress --only noise --seed 136 --seconds 1`,
    `slipguard stress --seconds 0 --out stress/`
    """
    from rich.console import Console

    from slipguard.stress.report import as_json, draw, print_table, summary
    from slipguard.stress.runner import chosen, full_hours, run
    from slipguard.tools.parallel import Workers

    families = chosen(only or [])
    workers = Workers(jobs, cluster)
    if out is not None:
        _make_folder(out)
    progress = Console(stderr=True)

    def note(outcome: StressOutcome) -> None:
        if out is not None:
            _write(out / "stress.json", jsonlib.dumps(as_json(outcome), indent=1) + "\n")

    with progress_bar("stress") as show:
        if seconds == 0.0:
            progress.print(f"the full list takes about {full_hours(families):.2g} h of one core")
            outcome = _whole(families, seed, workers, lambda share, family: show(family, share), note)
        else:
            outcome = run(families, seed, seconds, progress=lambda share, family: show(family, share))
    if json:
        print(jsonlib.dumps(summary(outcome)))
    else:
        print_table(Console(), outcome)
    note(outcome)
    if out is not None:
        draw(outcome, out / PICTURE)
        progress.print(f"picture: {out / PICTURE}")
    if outcome.failed:
        raise typer.Exit(1)


def _whole(
    families: tuple[TrialFamily, ...],
    seed: int,
    workers: Workers,
    progress: Callable[[float, str], None],
    note: Callable[[StressOutcome], None],
) -> StressOutcome:
    """All of the list; what has been found is noted now and then."""
    from slipguard.stress.runner import run_whole

    for outcome in run_whole(families, seed, workers=workers, progress=progress):
        note(outcome)
    return outcome


def _make_folder(path: Path) -> None:
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"--out {path}: cannot be made: {error}") from error


def _write(path: Path, text: str) -> None:
    try:
        write_whole(path, text.encode(), 0o644)
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error}") from error
