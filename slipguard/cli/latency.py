"""`slipguard latency`: from a frame's time stamp to the command's last byte on the wire, against an emulated cell."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from slipguard.cli.interrupt import left_to_the_loop
from slipguard.cli.progress import progress_bar
from slipguard.errors import InputError, SlipguardError
from slipguard.priority import go_first

if TYPE_CHECKING:
    from rich.console import Console

    from slipguard.lab.crowd import CrowdOptions
    from slipguard.lab.wire_latency import Latency

PAIRS, BLOCK_S = 6, 8.0


def latency(
    commands: Annotated[int, typer.Option(min=2, max=220, help="How many commands are measured.")] = 200,
    fps: Annotated[Literal["60", "30"], typer.Option(help="Rate of the emulated cameras.")] = "60",
    baud: Annotated[int, typer.Option(min=0, help="Pace of the serial line; 0: as fast as it goes.")] = 115200,
    clients: Annotated[
        int | None,
        typer.Option(min=1, max=60, help="What so many clients of page and API cost the loop, instead: two minutes."),
    ] = None,
    pairs: Annotated[
        int | None,
        typer.Option(
            min=1,
            max=100,
            help=f"With --clients: how often alone and with them, turn and turn about; default: {PAIRS}.",
        ),
    ] = None,
    block_s: Annotated[
        float | None,
        typer.Option(min=0.5, max=600.0, help=f"With --clients: seconds of each turn; default: {BLOCK_S:g}."),
    ] = None,
    as_service: Annotated[
        bool, typer.Option("--as-service", help="With the real-time priority that the service has; needs root.")
    ] = False,
    json: Annotated[bool, typer.Option("--json", help="One JSON object.")] = False,
) -> None:
    """Measure from a frame's time stamp to the command's last byte on the serial line, stage by stage.

    Runs the daemon and the real gripper driver against an emulated cell: about a minute. Every frame is looked at in
    full, and drawing the emulated cameras' pictures takes its share of this machine. With `--clients` the loop's own
    latency is measured, alone and with the clients, turn and turn about; it fails where they cost too much, or were not
    served.
    Example: `slipguard latency --commands 100`, `slipguard latency --clients 50`
    """
    import json as jsonlib
    import logging
    from dataclasses import asdict

    from rich.console import Console

    from slipguard.daemon import log
    from slipguard.lab.wire_latency import Options, measure

    if clients is None and (pairs is not None or block_s is not None):
        raise InputError("--pairs and --block-s belong to --clients N")
    log.configure(level=logging.CRITICAL)
    if as_service:
        go_first()
    if clients is not None:
        from slipguard.lab.crowd import CrowdOptions

        _with_clients(CrowdOptions(clients, pairs or PAIRS, block_s or BLOCK_S, int(fps)), json)
        return
    with progress_bar("latency") as show, left_to_the_loop():
        found = asyncio.run(measure(Options(commands=commands, baud=baud, fps=int(fps)), show))
    if json:
        print(jsonlib.dumps(asdict(found)))
    else:
        _show(Console(highlight=False), found)


def _with_clients(options: CrowdOptions, json: bool) -> None:
    import json as jsonlib
    from dataclasses import asdict

    from rich.console import Console
    from rich.table import Table

    from slipguard.lab.crowd import measure_crowd

    with progress_bar("latency") as show, left_to_the_loop():
        found = asyncio.run(measure_crowd(options, show))
    told = f"p99 rises by {found.rise_ms:+.2f} ms; {found.allowed_ms:.2f} ms are allowed"
    if json:
        print(jsonlib.dumps(asdict(found) | {"rise_ms": found.rise_ms, "allowed_ms": found.allowed_ms}))
    else:
        title = f"{options.pairs} x {options.block_s:g} s each, {options.fps} fps, every frame looked at in full"
        table = Table("frame handed over to decision, ms", title=title, title_justify="left")
        for name in ("p50", "p99", "largest", "beats missed"):
            table.add_column(name, justify="right")
        for what, one, missed in (
            ("alone", found.alone, found.missed[0]),
            (f"{options.clients} clients", found.crowded, found.missed[1]),
        ):
            table.add_row(what, f"{one.p50_ms:.2f}", f"{one.p99_ms:.2f}", f"{one.largest_ms:.1f}", str(missed))
        console = Console(highlight=False)
        console.print(table)
        console.print(told, "; they got", ", ".join(f"{count} {what}" for what, count in found.got.items()))
    if found.unserved:
        raise SlipguardError(found.unserved)
    if found.rise_ms > found.allowed_ms:
        raise SlipguardError(f"with {options.clients} clients {told}")


def _show(console: Console, found: Latency) -> None:
    from rich.table import Table

    from slipguard.lab.wire_latency import OWN, TOTAL

    options = found.options
    pace = f"{options.baud} Bd" if options.baud else "without pacing"
    table = Table("stage, ms", title=f"{found.commands} commands, {options.fps} fps, {pace}", title_justify="left")
    for name in ("p50", "p99", "largest"):
        table.add_column(name, justify="right")
    for stage, spread in found.stages.items():
        if stage == TOTAL:
            table.add_section()
        style = "bold" if stage in (TOTAL, OWN) else ""
        table.add_row(stage, f"{spread.p50_ms:.1f}", f"{spread.p99_ms:.1f}", f"{spread.largest_ms:.1f}", style=style)
    console.print(table)
