"""`slipguard stress`: numerical stability under perturbations of the same grasps."""

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
    only: Annotated[list[str] | None, typer.Option(help="Apply only this perturbation; may be repeated.")] = None,
    json: JsonOption = False,
    out: Annotated[Path | None, typer.Option(help="Folder for a plot and stress.json.")] = None,
) -> None:
    """Perturb the same grasps: camera faults, noise, degenerate masks, NaN, odd clocks, gaps, effects of real contacts.

    Exits 1 if an estimate crashed, was NaN or confidently wrong (beyond 4 sigma), drifted, or was declined too often.
    Effects of real contacts are swept until estimates are confidently wrong: `broken_at` reports from which size on,
    and that is no failure.

    Example: `slipguard stress --seconds 60 --out stress/`, `slipguard stress --only gain --seed 136 --seconds 1`
    """
    from rich.console import Console

    from slipguard.stress.report import PLOT, draw, print_table
    from slipguard.stress.run import SUMMARY, run
    from slipguard.tools.figures import write_json

    make_folder(out)
    with progress_bar("stress") as show:
        found = run(only or [], seed, seconds, progress=lambda share: show("stress", share))
    figures = found.as_json()
    if json:
        print(jsonlib.dumps({key: figures[key] for key in SUMMARY}))
    else:
        print_table(Console(), found)
    if out is not None:
        write_json(out / "stress.json", figures)
        draw(found, out / PLOT)
        Console(stderr=True).print(f"plot: {out / PLOT}")
    if found.failures:
        raise typer.Exit(1)
