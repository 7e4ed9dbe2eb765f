"""`slipguard bench`: time and error of perception on this machine, and the grip controller in closed loop."""

from __future__ import annotations

import json as jsonlib
import shlex
import sys
from pathlib import Path
from typing import Annotated

import typer

WIDE = 190


def bench(
    quick: Annotated[
        bool, typer.Option("--quick/--full", help="--quick: one grasp of each object, about a minute.")
    ] = True,
    json: Annotated[bool, typer.Option("--json", help="Print one JSON object instead of tables.")] = False,
    out: Annotated[
        Path | None, typer.Option(help="Folder for bench.json and bench.png; with --grip for grip.json and grip.png.")
    ] = None,
    model: Annotated[Path | None, typer.Option(help="Network (.onnx) to use instead of the shipped one.")] = None,
    models: Annotated[Path | None, typer.Option(help="Folder of further networks, such as the paper's.")] = None,
    table: Annotated[
        Path | None, typer.Option(help="Markdown file whose table between the markers is replaced.")
    ] = None,
    jobs: Annotated[int, typer.Option(help="Processes for the parts that are not timed; 0: one per core.")] = 0,
    cluster: Annotated[
        str | None, typer.Option(help="Dask scheduler for the parts that are not timed: tcp://HOST:8786.")
    ] = None,
    grip: Annotated[
        bool, typer.Option("--grip", help="Run the grip controller in closed loop and compare it with others.")
    ] = False,
    seed: Annotated[int, typer.Option(help="With --grip: seed of the first run.")] = 0,
) -> None:
    """Measure time and error of slipguard's perception, the paper's pipeline and others; or test the grip controller.

    Example: `slipguard bench --quick --out bench/`; everything: `slipguard bench --full --models models`; closed
    loop: `slipguard bench --grip --out grip/`
    """
    from slipguard.errors import InputError

    if grip and (model is not None or models is not None or table is not None):
        raise InputError("--grip uses the shipped network. Remove --model, --models and --table")
    from rich.console import Console

    from slipguard.bench import run, tables
    from slipguard.bench.plot import draw_bench
    from slipguard.cli.progress import progress_bar
    from slipguard.tools.parallel import Workers

    if out is not None:
        try:
            out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"--out {out}: cannot create the folder: {error.strerror}") from error
    if grip:
        from slipguard.cli.bench_grip import bench_grip

        bench_grip(quick=quick, seed=seed, json=json, out=out, workers=Workers(jobs, cluster))
        return
    options = run.BenchOptions(quick, model, models, Workers(jobs, cluster))
    if table is not None:
        tables.split_at_markers(table)
    with progress_bar("bench") as show:
        found = run.bench(options, show)
    if out is not None:
        draw_bench(found, out / "bench.png")
        (out / "bench.json").write_text(jsonlib.dumps(found.as_json(), indent=2) + "\n", encoding="utf-8")
    if table is not None:
        command = shlex.join(["slipguard", *sys.argv[1:]])
        tables.write_into(table, tables.markdown(found, command))
    if json:
        print(jsonlib.dumps(found.as_json()))
        return
    console = Console()
    for shown in tables.bench_tables(found, brief=console.width < WIDE):
        console.print(shown)
    for line in tables.notes(found):
        console.print(line, style="dim")
