"""`python -m tests.campaigns faults`: the whole daemon on virtual time, with faults."""

from __future__ import annotations

import json as jsonlib
from pathlib import Path
from typing import Annotated

import typer


def faults(
    runs: Annotated[int, typer.Option(min=1, help="How many runs with one to three faults each; 1: print its log.")],
    seed: Annotated[int, typer.Option(help="Seed of the first run; the same seed gives the same run.")] = 0,
    jobs: Annotated[int, typer.Option(help="Processes; 0: one per core.")] = 0,
    cluster: Annotated[str | None, typer.Option(help="Dask scheduler: tcp://HOST:8786.")] = None,
    json: Annotated[bool, typer.Option("--json", help="One JSON object.")] = False,
    out: Annotated[Path | None, typer.Option(help="Folder for faults.json.")] = None,
) -> None:
    """Run the daemon on virtual time with one to three faults per run; exit 1 if a safety rule was broken.

    Example: `python -m tests.campaigns faults --runs 1000`
    """
    from rich.console import Console

    from slipguard.cli.progress import count_bar
    from slipguard.tools.parallel import Workers
    from tests.campaigns.faults import report
    from tests.campaigns.faults.campaign import Campaign, campaign, quiet_trial

    console = Console(stderr=json)
    if runs == 1:
        outcome = quiet_trial(seed)
        found = Campaign()
        found.count(outcome)
        report.show_run(console, outcome)
    else:
        with count_bar("runs with faults", runs) as show:
            found = campaign(runs, seed, Workers(jobs, cluster), show)
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        (out / "faults.json").write_text(jsonlib.dumps(found.as_json(), indent=2) + "\n", encoding="utf-8")
    if json:
        print(jsonlib.dumps(found.as_json()))
    else:
        report.show(console, found)
    if found.failures:
        raise typer.Exit(1)
