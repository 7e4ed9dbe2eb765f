"""`slipguard --sim`: simulated lifts with a live display, a table and a plot."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from slipguard.cli.interrupt import default_interrupts
from slipguard.cli.terminal import make_folder
from slipguard.errors import InputError

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from slipguard.sim_lifts.campaign import CampaignSettings, LiftProgress
    from slipguard.sim_lifts.lift_record import LiftRecord

LIFT_TAKES_S = 7
"""One lift on the real clock: close 1 s, lift 3 s, hold 1 s, lower and open 2 s."""


class Speed(StrEnum):
    """Clock of a simulation."""

    realtime = "realtime"
    fast = "fast"


def simulate(*, seed: int, lifts: int | None, guarded: bool, json: bool, out: Path | None, speed: Speed) -> None:
    """Run the lifts; exit code 1 if an object was dropped. A machine that is too slow gets a virtual clock."""
    import logging

    from rich.console import Console

    from slipguard.daemon import log_setup as log
    from slipguard.daemon.loop.virtual_time import run_virtual
    from slipguard.sim_lifts.campaign import CampaignSettings, run_campaign
    from slipguard.sim_lifts.report import draw, print_lines, print_tables

    if lifts is not None and lifts < 1:
        raise InputError(f"--lifts {lifts}: at least one lift is needed")
    make_folder(out)
    log.configure(level=logging.CRITICAL)
    realtime = speed is Speed.realtime
    settings = CampaignSettings(seed=seed, lifts=lifts, guarded=guarded, realtime=realtime)
    console, progress = Console(highlight=False), Console(stderr=True)
    if not json:
        console.print(_announcement(settings))
    with default_interrupts():
        with _display(progress) as show:
            runner = asyncio.run if realtime else run_virtual
            records = runner(run_campaign(settings, show))
        slow = _too_slow(records) if realtime else None
        if slow is not None:
            progress.print(slow, style="yellow", highlight=False, soft_wrap=True)
            realtime = False
            with _display(progress) as show:
                records = run_virtual(run_campaign(replace(settings, realtime=False), show))
    if json:
        print_lines(records, realtime=realtime)
    else:
        print_tables(console, records, realtime=realtime)
    if out is not None:
        plot = out / ("guarded.png" if guarded else "unguarded.png")
        draw(records, plot)
        progress.print(f"plot: {plot}", highlight=False, soft_wrap=True)
    if not json:
        console.print(_next_steps(settings, out), style="dim")
    if any(record.outcome == "dropped" for record in records):
        raise typer.Exit(1)


def _too_slow(records: list[LiftRecord]) -> str | None:
    """Return a warning if the machine was too slow for the simulated cameras or the loop; None if it was not."""
    from slipguard.sim_lifts.campaign import ended_by_busy_machine

    late = next((record for record in records if ended_by_busy_machine(record)), None)
    if late is None:
        return None
    return (
        f"lift {len(records)} ended early ({late.why}): this machine is too busy or too slow to simulate two cameras "
        "in real time. All lifts are repeated on a virtual clock, as with --speed fast; latencies are not measured."
    )


def _announcement(settings: CampaignSettings) -> str:
    count = len(settings.objects())
    guard = (
        "slipguard tightens the grip when the gel images show slip"
        if settings.guarded
        else "without the guard: the grip force does not change"
    )
    takes = f"about {count * LIFT_TAKES_S} s" if settings.realtime else "as fast as possible"
    return (
        f"{count} {'lift' if count == 1 else 'lifts'} of objects held off their center of mass, on simulated sensors, "
        f"gripper and arm; {guard}. Seed {settings.seed}, {takes}."
    )


def _next_steps(settings: CampaignSettings, out: Path | None) -> str:
    seed = f" --seed {settings.seed}" if settings.seed else ""
    if settings.guarded:
        steps = [(f"slipguard --sim --no-guard{seed}", "the same lifts without the guard")]
    else:
        steps = [(f"slipguard --sim{seed}", "the same lifts with the guard")]
    if out is None:
        steps.append((f"slipguard --sim --out sim/{seed}", "a plot of every lift"))
    steps.append(("slipguard run --sim", "the daemon, for `slipguard ctl`"))
    width = max(len(command) for command, _ in steps)
    return "\n".join(["next steps:", *(f"  {command:{width}}  {what}" for command, what in steps)])


@contextmanager
def _display(console: Console) -> Iterator[Callable[[LiftProgress], None]]:
    """Show a live table on a terminal; nothing on a pipe."""
    from rich.live import Live as Screen

    newest: list[LiftProgress] = []
    if not console.is_terminal:
        yield lambda live: None
        return
    with Screen(
        get_renderable=lambda: _table(newest[-1] if newest else None),
        console=console,
        refresh_per_second=8,
        transient=True,
    ):
        yield lambda live: newest.__setitem__(slice(None), [live])


def _table(live: LiftProgress | None) -> Table:
    from rich.table import Table

    table = Table.grid(padding=(0, 2))
    if live is None:
        table.add_row("starting the simulated cell …")
        return table
    rotation = "no estimate" if live.rotation_deg is None else f"{live.rotation_deg:+6.1f}° ± {live.sigma_deg:.1f}°"
    table.add_row(f"lift {live.lift} of {live.lifts}", f"[bold]{live.object_name}[/]", live.phase)
    table.add_row("rotation", rotation, f"true {live.true_rotation_deg:+6.1f}°")
    bar = "█" * round(live.force_n / 5)
    table.add_row("grip", f"{live.force_n:5.0f} N", bar)
    if live.latency_ms is not None:
        table.add_row("latency", f"{live.latency_ms:5.1f} ms", "")
    return table
