"""`slipguard bench --grip --faults N`: the whole daemon on virtual time, with faults."""

from __future__ import annotations

import json as jsonlib
from pathlib import Path

import typer


def bench_faults(runs: int, seed: int, jobs: int, cluster: str | None, json: bool, out: Path | None) -> None:
    """The fault campaign; a single run is shown line by line. Fails where anything happened that must not."""
    from rich.console import Console

    from slipguard.cli.progress import count_bar
    from slipguard.errors import InputError
    from slipguard.lab.faults import report
    from slipguard.lab.faults.campaign import Campaign, campaign, quiet_trial
    from slipguard.lab.parallel import Workers

    if runs < 1:
        raise InputError(f"--faults {runs}: a number of runs is needed, 1 or more")
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
