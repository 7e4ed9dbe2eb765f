"""`python -m tests.campaigns soak`: hours of work on the fakes; memory, tasks, threads and files are monitored."""

from __future__ import annotations

import asyncio
import json as jsonlib
import logging
from contextlib import ExitStack
from dataclasses import asdict
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from slipguard.cli.interrupt import default_interrupts
from slipguard.cli.terminal import progress_bar
from slipguard.daemon import log_setup as log
from slipguard.daemon.loop.virtual_time import run_virtual
from slipguard.errors import InputError
from slipguard.thread_priority import set_realtime_priority
from tests.campaigns.soak.checks import GROWTH_SAMPLES_MIN, growth_judged
from tests.campaigns.soak.resources import ResourceSample
from tests.campaigns.soak.run import SoakResult, run_soak
from tests.campaigns.soak.settings import SoakSettings

SHORTEST_S = 10.0


class ClockKind(StrEnum):
    """The daemon's clock."""

    virtual = "virtual"
    real = "real"


def soak(
    hours: Annotated[float, typer.Option(min=0.0, help="Duration on the daemon's clock.")] = 0.0,
    minutes: Annotated[float, typer.Option(min=0.0, help="Added to --hours.")] = 0.0,
    clock: Annotated[
        ClockKind, typer.Option(help="virtual: as fast as it computes; real: deadlines count.")
    ] = ClockKind.virtual,
    page: Annotated[bool, typer.Option("--page", help="Keep an operator page open all the time.")] = False,
    recording: Annotated[bool, typer.Option("--recording/--no-recording", help="Record into the ring.")] = True,
    seed: Annotated[int, typer.Option(min=0, help="Seed of objects, faults and pauses.")] = 0,
    samples: Annotated[
        Path | None, typer.Option(help="File for the resource samples, as JSON lines, written as they are taken.")
    ] = None,
    as_service: Annotated[
        bool, typer.Option("--as-service", help="With the real-time priority of the service; needs root.")
    ] = False,
    json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Run the daemon on the fakes for hours; exit 1 if anything grows, leaks or misses its deadline.

    Objects are lifted, devices fail and recover, recordings run. On the virtual clock an hour takes a minute or two:
    the cameras deliver 15 images per second of the untouched gel, the loop period is 50 ms, the rotation comes from the
    simulated world, and every half hour one lift runs with rendered images and the network. On the real clock
    everything runs as with `slipguard run --sim`. Growth is judged in soaks of about ten minutes and more.

    Example: `python -m tests.campaigns soak --hours 8`, `python -m tests.campaigns soak --minutes 10 --clock real
    --page --as-service`
    """
    log.configure(level=logging.CRITICAL)
    if as_service:
        set_realtime_priority()
    length_s = 3600.0 * hours + 60.0 * minutes
    if length_s < SHORTEST_S:
        raise InputError(f"{length_s:g} s is too short for one lift; give --hours 8 or --minutes 10")
    settings = SoakSettings(length_s, clock is ClockKind.virtual, seed=seed, page=page, recording=recording)
    found = _run(settings, samples)
    if json:
        print(jsonlib.dumps(asdict(found) | {"good": found.good}))
    else:
        _print(Console(highlight=False), found)
    if not found.good:
        raise typer.Exit(1)


def _run(settings: SoakSettings, samples: Path | None) -> SoakResult:
    with ExitStack() as opened:
        file = opened.enter_context(samples.open("w")) if samples is not None else None
        opened.enter_context(default_interrupts())
        show = opened.enter_context(progress_bar("soak"))

        def report(sample: ResourceSample, done: str) -> None:
            show(done, sample.at_s / settings.length_s)
            if file is not None:
                file.write(jsonlib.dumps(asdict(sample)) + "\n")
                file.flush()

        return (run_virtual if settings.virtual else asyncio.run)(run_soak(settings, report))


def _print(console: Console, found: SoakResult) -> None:
    settings = found.settings
    kind = "virtual" if settings.virtual else "real"
    title = f"{settings.length_s / 3600:.2f} h on the {kind} clock, {len(found.samples)} samples, {found.took_s:.0f} s"
    table = Table("", title=title, title_justify="left")
    for name in ("found", "limit", ""):
        table.add_column(name, justify="right")
    for one in found.checks:
        share = "growth" in one.what or "share" in one.what
        value, limit = (f"{number:.2%}" if share else f"{number:.0f}" for number in (one.value, one.limit))
        bad = "[bold red]too little[/]" if one.at_least else "[bold red]too much[/]"
        table.add_row(one.what, value, f"{'≥' if one.at_least else '≤'} {limit}", "good" if one.good else bad)
    console.print(table)
    if not growth_judged(found.samples):
        samples = f"{len(found.samples)} samples; {GROWTH_SAMPLES_MIN} are needed"
        console.print(f"growth of memory is not judged ({samples}): give --minutes 10 or more")
    console.print("; ".join(f"{what} {count}" for what, count in sorted(found.counts.items())))
    first, last = found.samples[0], found.samples[-1]
    console.print(
        f"memory {first.rss_mb:.0f} MB at first, {last.rss_mb:.0f} MB at last; "
        f"{found.left_out} values left out of the recordings"
    )
    for where, size in found.grown.items():
        console.print(f"  +{size / 1024:.1f} KiB in the last {found.traced_s / 60:.0f} minutes: {where}")
