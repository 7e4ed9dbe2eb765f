"""`python -m tests.campaigns soak`: hours of work on the fakes, with memory, tasks, threads and files watched."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from slipguard.cli.interrupt import default_interrupts
from slipguard.cli.progress import progress_bar
from slipguard.errors import InputError
from slipguard.thread_priority import set_realtime_priority

if TYPE_CHECKING:
    from rich.console import Console

    from tests.campaigns.soak.run import Soak

SHORTEST_S = 10.0


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
    recording_cost: Annotated[
        int | None,
        typer.Option(min=1, help="Instead: lift so many objects with and without recordings, and compare."),
    ] = None,
    as_service: Annotated[
        bool, typer.Option("--as-service", help="With the real-time priority that the service has; needs root.")
    ] = False,
    json: Annotated[bool, typer.Option("--json", help="One JSON object.")] = False,
) -> None:
    """Run the daemon on the fakes for hours and tell whether anything grows, leaks or comes late.

    Object after object is lifted, devices fail and come back, the recordings run. On the virtual clock an hour takes a
    minute or two: the cameras deliver 15 pictures a second, of the untouched gel, the loop turns every 50 ms, the
    simulated world tells the turn, and a lift with drawn pictures through the network comes every half hour. On the
    real clock all is as with `slipguard run --sim`.

    Example: `python -m tests.campaigns soak --hours 8`, `python -m tests.campaigns soak --minutes 10 --clock real
    --page --as-service`, `python -m tests.campaigns soak --recording-cost 10`
    """
    import logging

    from slipguard.daemon import logging as log

    log.configure(level=logging.CRITICAL)
    if as_service:
        set_realtime_priority()
    length_s = 3600.0 * hours + 60.0 * minutes
    if recording_cost is not None:
        if length_s:
            raise InputError("--recording-cost lasts as long as its lifts; leave --hours and --minutes out")
        good = _compare(recording_cost, seed, json)
    elif length_s < SHORTEST_S:
        raise InputError(f"{length_s:g} s is too short to see anything grow; say --hours 8 or --minutes 10")
    else:
        good = _endure(length_s, clock is ClockKind.virtual, page, recording, seed, pulses, json)
    if not good:
        raise typer.Exit(1)


def _endure(
    length_s: float, virtual: bool, page: bool, recording: bool, seed: int, pulses: Path | None, json: bool
) -> bool:
    import asyncio
    import json as jsonlib
    from contextlib import ExitStack
    from dataclasses import asdict

    from rich.console import Console

    from slipguard.daemon.loop.virtual_time import run_virtual
    from tests.campaigns.soak.resources import ResourceSample
    from tests.campaigns.soak.run import soak as run_soak
    from tests.campaigns.soak.settings import SoakSettings

    settings = SoakSettings(length_s, virtual, seed=seed, page=page, recording=recording)
    with ExitStack() as open_things:
        file = open_things.enter_context(pulses.open("w")) if pulses is not None else None
        open_things.enter_context(default_interrupts())
        show = open_things.enter_context(progress_bar("soak"))

        def felt(pulse: ResourceSample, done: str) -> None:
            show(done, pulse.at_s / length_s)
            if file is not None:
                file.write(jsonlib.dumps(asdict(pulse)) + "\n")
                file.flush()

        found = (run_virtual if virtual else asyncio.run)(run_soak(settings, felt))
    if json:
        print(jsonlib.dumps(asdict(found) | {"good": found.good}))
    else:
        _show(Console(highlight=False), found)
    return found.good


def _compare(pairs: int, seed: int, json: bool) -> bool:
    import asyncio
    import json as jsonlib
    from dataclasses import asdict

    from rich.console import Console
    from rich.table import Table

    from tests.campaigns.recording_cost import LOOP_SHARE_MAX, measure

    with progress_bar("recording cost") as show, default_interrupts():
        cost = asyncio.run(measure(pairs, seed, show))
    if json:
        print(jsonlib.dumps(asdict(cost) | {"good": cost.good}))
        return cost.good
    table = Table("lifts", "latencies", "p50", "p99", "loop's thread", "process", "deadlines missed")
    for one in (cost.without, cost.recorded):
        table.add_row(
            f"{one.lifts} {'recorded' if one is cost.recorded else 'not recorded'}",
            str(one.latencies),
            f"{one.latency_p50_ms:.1f} ms",
            f"{one.latency_p99_ms:.1f} ms",
            f"{one.loop_share:.1%} of a core",
            f"{one.process_share:.1%}",
            f"{one.missed_share:.2%}",
        )
    console = Console(highlight=False)
    console.print(table)
    console.print(
        f"handing {cost.handed} values over took {cost.handing_share:.1%} of the loop thread's time "
        f"(allowed: {LOOP_SHARE_MAX:.0%}), the longest {cost.longest_hand_ms:.2f} ms; {cost.left_out} left out"
    )
    return cost.good


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
        bad = "[bold red]too little[/]" if one.at_least else "[bold red]too much[/]"
        table.add_row(one.what, value, f"{'≥' if one.at_least else '≤'} {allowed}", "good" if one.good else bad)
    console.print(table)
    console.print("; ".join(f"{what} {count}" for what, count in sorted(found.counts.items())))
    first, last = found.pulses[0], found.pulses[-1]
    console.print(
        f"memory {first.rss_mb:.0f} MB at first, {last.rss_mb:.0f} MB at last; "
        f"{found.left_out} values left out of the recordings"
    )
    for where, size in found.grown.items():
        console.print(f"  +{size / 1024:.1f} KiB in the last {found.traced_s / 60:.0f} minutes: {where}")
