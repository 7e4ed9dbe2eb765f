"""`slipguard bench`: run time and error of the perception, or with --grip the controller in closed loop."""

from __future__ import annotations

import json as jsonlib
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from slipguard.cli.options import JsonOption
from slipguard.cli.terminal import make_folder, progress_bar
from slipguard.errors import InputError

if TYPE_CHECKING:
    from slipguard.tools.parallel import Workers


def bench(
    quick: Annotated[bool, typer.Option("--quick/--full", help="One grasp of each object: about a minute.")] = True,
    json: JsonOption = False,
    out: Annotated[
        Path | None, typer.Option(help="Folder for bench.json and bench.png; with --grip for grip.json and grip.png.")
    ] = None,
    model: Annotated[Path | None, typer.Option(help="Network (.onnx) to use instead of the shipped one.")] = None,
    models: Annotated[
        Path | None, typer.Option(help="Folder of networks to compare, for example those of the paper.")
    ] = None,
    jobs: Annotated[
        int, typer.Option(help="With --full or --grip: processes for the parts that are not timed; 0: one per core.")
    ] = 0,
    cluster: Annotated[
        str | None,
        typer.Option(help="With --full or --grip: Dask scheduler for the parts that are not timed: tcp://HOST:8786."),
    ] = None,
    grip: Annotated[
        bool, typer.Option("--grip", help="Compare grip controllers in closed loop: rotation, slip and grip force.")
    ] = False,
    plant: Annotated[
        str, typer.Option(help="With --grip: the physics: own, mujoco (needs the extra mujoco), or both.")
    ] = "both",
    seed: Annotated[
        int,
        typer.Option(
            min=0, help="With --grip: seed of the scenarios. Tune on seeds below 1000; state results of 1000 and up."
        ),
    ] = 0,
) -> None:
    """Measure run time and error of the perception pipeline, compared with the paper's; or compare grip controllers.

    Example: `slipguard bench --quick --out bench/`, `slipguard bench --full --models models`,
    `slipguard bench --grip --out grip/`
    """
    if grip and (model is not None or models is not None):
        raise InputError("--grip uses the shipped network; omit --model and --models")
    if not grip and (plant != "both" or seed):
        raise InputError("--plant and --seed choose scenarios of --grip; add --grip, or omit them")
    if quick and not grip and cluster is not None:
        raise InputError("the quick bench runs in this process alone; add --full, or omit --cluster")
    from rich.console import Console

    from slipguard.bench import run, tables
    from slipguard.bench.plot import draw_bench
    from slipguard.tools.figures import write_json
    from slipguard.tools.parallel import Workers

    make_folder(out)
    if grip:
        bench_grip(quick=quick, seed=seed, plant=plant, json=json, out=out, workers=Workers(jobs, cluster))
        return
    options = run.BenchOptions(quick, model, models, Workers(jobs, cluster))
    with progress_bar("bench") as show:
        found = run.bench(options, show)
    if out is not None:
        draw_bench(found, out / "bench.png")
        write_json(out / "bench.json", found.as_json())
    if json:
        print(jsonlib.dumps(found.as_json()))
        return
    console = Console()
    for shown in tables.bench_tables(found):
        console.print(shown)
    for line in tables.notes(found):
        console.print(line, style="dim")


def bench_grip(*, quick: bool, seed: int, plant: str, json: bool, out: Path | None, workers: Workers) -> None:
    """Run the scenarios of the grip controllers on each plant; exit code 1 if a figure exceeds its limit."""
    from rich.console import Console

    from slipguard.bench.grip.campaign import CampaignPlan, run
    from slipguard.bench.grip.json_figures import as_json, checks, failures, scenarios_as_json
    from slipguard.bench.grip.lift_run import PLANTS
    from slipguard.bench.grip.plot import draw
    from slipguard.bench.grip.report import print_tables
    from slipguard.sim.mujoco_plant import MujocoPlant

    if plant not in (*PLANTS, "both"):
        raise InputError(f"--plant {plant}: must be own, mujoco or both")
    progress = Console(stderr=True)
    if plant != "own":
        try:
            MujocoPlant()
        except InputError as missing:
            if plant == "mujoco":
                raise
            progress.print(f"only the plant own is measured: {missing}")
            plant = "own"
    plans = [CampaignPlan.of(quick=quick, seed=seed, plant=one) for one in PLANTS if plant in (one, "both")]
    found = []
    for plan in plans:
        progress.print(
            f"{len(plan.scenarios)} scenarios on the plant {plan.plant}, {plan.seed_set} seed {seed}, {plan.rendered} "
            "also with rendered frames",
            highlight=False,
        )
        with progress_bar("grip controllers") as show:
            found.append(run(plan, workers, lambda share: show("grip controllers", share)))
    figures = [as_json(one) for one in found]
    for one in figures:
        one["promised"] = [check.as_json() for check in checks(one)]
    both = figures[0] | {one["plant"]: one for one in figures[1:]}
    if out is not None:
        draw(found, out / "grip.png")
        parts = [shown | scenarios_as_json(one) for shown, one in zip(figures, found, strict=True)]
        whole = parts[0] | {one["plant"]: one for one in parts[1:]}
        (out / "grip.json").write_text(jsonlib.dumps(whole, indent=2) + "\n", encoding="utf-8")
    if json:
        print(jsonlib.dumps(both))
    else:
        print_tables(Console(highlight=False), found)
    failed = [line for one in figures for line in failures(one)]
    for line in failed:
        progress.print(line, style="red", highlight=False)
    if failed:
        raise typer.Exit(1)
