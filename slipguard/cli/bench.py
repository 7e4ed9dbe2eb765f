"""`slipguard bench`: run time and error of the perception, or with --grip the controller in closed loop."""

from __future__ import annotations

import json as jsonlib
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from slipguard.cli.terminal import make_folder, progress_bar
from slipguard.errors import InputError

if TYPE_CHECKING:
    from slipguard.tools.parallel import Workers


def bench(
    quick: Annotated[bool, typer.Option("--quick/--full", help="One grasp of each object: about a minute.")] = True,
    json: Annotated[bool, typer.Option("--json", help="Print one JSON object instead of the tables.")] = False,
    out: Annotated[
        Path | None, typer.Option(help="Folder for bench.json and bench.png; with --grip for grip.json and grip.png.")
    ] = None,
    model: Annotated[Path | None, typer.Option(help="Network (.onnx) to use instead of the shipped one.")] = None,
    models: Annotated[
        Path | None, typer.Option(help="Folder of networks to compare, for example those of the paper.")
    ] = None,
    jobs: Annotated[int, typer.Option(help="Processes for the parts that are not timed; 0: one per core.")] = 0,
    cluster: Annotated[
        str | None, typer.Option(help="Dask scheduler for the parts that are not timed: tcp://HOST:8786.")
    ] = None,
    grip: Annotated[
        bool, typer.Option("--grip", help="Compare grip controllers in closed loop: rotation, slip and grip force.")
    ] = False,
    seed: Annotated[int, typer.Option(help="With --grip: random seed of the first trial.")] = 0,
) -> None:
    """Measure run time and error of the perception pipeline, compared with the paper's; or compare grip controllers.

    Example: `slipguard bench --quick --out bench/`, `slipguard bench --full --models models`,
    `slipguard bench --grip --out grip/`
    """
    if grip and (model is not None or models is not None):
        raise InputError("--grip uses the shipped network; omit --model and --models")
    from rich.console import Console

    from slipguard.bench import run, tables
    from slipguard.bench.plot import draw_bench
    from slipguard.tools.parallel import Workers

    make_folder(out)
    if grip:
        bench_grip(quick=quick, seed=seed, json=json, out=out, workers=Workers(jobs, cluster))
        return
    options = run.BenchOptions(quick, model, models, Workers(jobs, cluster))
    with progress_bar("bench") as show:
        found = run.bench(options, show)
    if out is not None:
        draw_bench(found, out / "bench.png")
        (out / "bench.json").write_text(jsonlib.dumps(found.as_json(), indent=2) + "\n", encoding="utf-8")
    if json:
        print(jsonlib.dumps(found.as_json()))
        return
    console = Console()
    for shown in tables.bench_tables(found):
        console.print(shown)
    for line in (*tables.skip_notes(found), *tables.notes(found)):
        console.print(line, style="dim")


def bench_grip(*, quick: bool, seed: int, json: bool, out: Path | None, workers: Workers) -> None:
    """Run the trials of the grip controllers; exit code 1 if a result exceeds its specified limit."""
    from rich.console import Console

    from slipguard.bench.grip.campaign import CampaignPlan, run
    from slipguard.bench.grip.campaign_figures import as_json, checks, failures, scenarios
    from slipguard.bench.grip.report import draw, print_tables

    plan = CampaignPlan.of(quick=quick, seed=seed)
    progress = Console(stderr=True)
    progress.print(
        f"{len(plan.trials)} lifts with a grip that is too weak ({plan.rendered} with rendered frames), "
        f"{len(plan.gone)} losses of support, {len(plan.tight)} lifts that need nearly the force limit, "
        f"{sum(one.seconds for one in plan.holds) / 60.0:.0f} minutes of stable holds",
        highlight=False,
    )
    with progress_bar("grip controllers") as show:
        found = run(plan, workers, lambda share: show("grip controllers", share))
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
