"""`slipguard bench`: run time against error on this machine."""

from __future__ import annotations

import json as jsonlib
import shlex
import sys
from pathlib import Path
from typing import Annotated

import typer

WIDE = 190


def bench(
    quick: Annotated[bool, typer.Option("--quick/--full", help="One grasp of each object: under a minute.")] = True,
    json: Annotated[bool, typer.Option("--json", help="One JSON object instead of the tables.")] = False,
    out: Annotated[
        Path | None, typer.Option(help="Folder for bench.json and bench.png; with --grip for grip.json and grip.png.")
    ] = None,
    model: Annotated[Path | None, typer.Option(help="Another network (.onnx) in place of the shipped one.")] = None,
    models: Annotated[Path | None, typer.Option(help="Folder of further networks, such as the paper's.")] = None,
    table: Annotated[
        Path | None, typer.Option(help="Markdown file whose table between the markers is renewed.")
    ] = None,
    jobs: Annotated[int, typer.Option(help="Processes for what is not timed; 0: one per core.")] = 0,
    cluster: Annotated[str | None, typer.Option(help="Dask scheduler for what is not timed: tcp://HOST:8786.")] = None,
    grip: Annotated[
        bool, typer.Option("--grip", help="The grip law in closed loop: how far things slip, beside others.")
    ] = False,
    seed: Annotated[int, typer.Option(help="With --grip: of the first run; the same seed, the same run.")] = 0,
) -> None:
    """Time the perception pipeline and measure its error, beside the paper's pipeline and others; or try the grip law.

    Example: `slipguard bench --quick --out bench/`; all of it: `slipguard bench --full --models models`; how far the
    law lets things slip: `slipguard bench --grip --out grip/`
    """
    from slipguard.errors import InputError

    if grip and (model is not None or models is not None or table is not None):
        raise InputError("--grip tries the grip law with the shipped network: no --model, --models or --table")
    from rich.console import Console

    from slipguard.bench import run, tables
    from slipguard.bench.plot import picture
    from slipguard.cli.progress import progress_bar
    from slipguard.tools.parallel import Workers

    if out is not None:
        try:
            out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"--out {out}: the folder cannot be made: {error.strerror}") from error
    if grip:
        from slipguard.cli.bench_grip import bench_grip

        bench_grip(quick=quick, seed=seed, json=json, out=out, workers=Workers(jobs, cluster))
        return
    options = run.BenchOptions(quick, model, models, Workers(jobs, cluster))
    if table is not None:
        tables.check(table)
    with progress_bar("bench") as show:
        found = run.bench(options, show)
    if out is not None:
        picture(found, out / "bench.png")
        (out / "bench.json").write_text(jsonlib.dumps(found.as_json(), indent=2) + "\n", encoding="utf-8")
    if table is not None:
        command = shlex.join(["slipguard", *sys.argv[1:]])
        tables.write_into(table, tables.markdown(found, command))
    if json:
        print(jsonlib.dumps(found.as_json()))
        return
    console = Console()
    for shown in tables.tables(found, brief=console.width < WIDE):
        console.print(shown)
    for line in tables.notes(found):
        console.print(line, style="dim")
