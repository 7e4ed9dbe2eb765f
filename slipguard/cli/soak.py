"""`slipguard soak`: hours of work on the fakes, with memory, tasks, threads and files watched."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from slipguard.cli.interrupt import left_to_the_loop
from slipguard.errors import InputError

if TYPE_CHECKING:
    from rich.console import Console

    from slipguard.lab.soak.run import Soak

MB = 2**20
SHORTEST_S = 60.0


class ClockKind(StrEnum):
    """Which clock the daemon lives on."""

    virtual = "virtual"
    real = "real"


def soak(
    hours: Annotated[float, typer.Option(min=0.0, help="How long, on the daemon's clock.")] = 0.0,
    minutes: Annotated[float, typer.Option(min=0.0, help="And so many minutes.")] = 0.0,
    clock: Annotated[
        ClockKind, typer.Option(help="virtual: as fast as it computes; real: deadlines count.")
    ] = ClockKind.virtual,
    page: Annotated[bool, typer.Option("--page", help="With an operator's page open all the time.")] = False,
    recording: Annotated[bool, typer.Option("--recording/--no-recording", help="With the ring of recordings.")] = True,
    seed: Annotated[int, typer.Option(min=0, help="Seed of objects, faults and pauses.")] = 0,
    pulses: Annotated[
        Path | None, typer.Option(help="File for each look at memory and files as it is taken, as JSON lines.")
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="One JSON object.")] = False,
) -> None:
    """Run the daemon on the fakes for hours and tell whether anything grows, leaks or comes late.

    Object after object is lifted, devices fail and come back, the recordings run. On the virtual clock an hour takes a
    few minutes: the cameras deliver 20 pictures a second, of the untouched gel, the loop turns every 20 ms, the
    simulated world tells the turn, and a lift with drawn pictures through the network comes every half hour. On the
    real clock all is as with `slipguard run --sim`.

    Example: `slipguard soak --hours 8`, `slipguard soak --minutes 10 --clock real --page`
    """
    import asyncio
    import json as jsonlib
    import logging
    from contextlib import ExitStack
    from dataclasses import asdict

    from rich.console import Console
    from rich.progress import Progress

    from slipguard.daemon import log
    from slipguard.daemon.virtual_time import run_virtual
    from slipguard.lab.soak.pulse import Pulse
    from slipguard.lab.soak.run import soak as run_soak
    from slipguard.lab.soak.settings import Settings

    length_s = 3600.0 * hours + 60.0 * minutes
    if length_s < SHORTEST_S:
        raise InputError(f"{length_s:g} s is too short to see anything grow; say --hours 8 or --minutes 10")
    log.configure(level=logging.CRITICAL)
    virtual = clock is ClockKind.virtual
    settings = Settings(length_s, virtual, seed=seed, page=page, recording=recording)
    progress = Console(stderr=True)
    with ExitStack() as open_things:
        file = open_things.enter_context(pulses.open("w")) if pulses is not None else None
        open_things.enter_context(left_to_the_loop())
        bar = open_things.enter_context(Progress(console=progress, transient=True, disable=not progress.is_terminal))
        task = bar.add_task("soak", total=length_s)

        def felt(pulse: Pulse, done: str) -> None:
            bar.update(task, completed=pulse.at_s, description=done)
            if file is not None:
                file.write(jsonlib.dumps(asdict(pulse)) + "\n")
                file.flush()

        found = (run_virtual if virtual else asyncio.run)(run_soak(settings, felt))
    if json:
        print(jsonlib.dumps(asdict(found) | {"good": found.good}))
    else:
        _show(Console(highlight=False), found)
    if not found.good:
        raise typer.Exit(1)


def _show(console: Console, found: Soak) -> None:
    from rich.table import Table

    settings = found.settings
    kind = "virtual" if settings.virtual else "real"
    title = f"{settings.length_s / 3600:.2f} h on the {kind} clock, {len(found.pulses)} looks, {found.took_s:.0f} s"
    table = Table("", title=title, title_justify="left")
    for name in ("found", "allowed", ""):
        table.add_column(name, justify="right")
    for one in found.findings:
        share = "growth" in one.what or "share" in one.what
        value, allowed = (f"{number:.2%}" if share else f"{number:.0f}" for number in (one.value, one.allowed))
        table.add_row(one.what, value, allowed, "good" if one.good else "[bold red]too much[/]")
    console.print(table)
    console.print("; ".join(f"{what} {count}" for what, count in sorted(found.counts.items())))
    first, last = found.pulses[0], found.pulses[-1]
    console.print(
        f"memory {first.rss_mb:.0f} MB at first, {last.rss_mb:.0f} MB at last; "
        f"{found.left_out} values left out of the recordings"
    )
    for where, size in found.grown.items():
        console.print(f"  +{size / 1024:.1f} KiB in the last {found.traced_s / 60:.0f} minutes: {where}")
