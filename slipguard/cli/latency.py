"""`slipguard latency`: latency from a frame's time stamp to the last byte of the command, with an emulated cell."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from slipguard.cli.interrupt import default_interrupts
from slipguard.cli.options import JsonOption
from slipguard.cli.terminal import progress_bar
from slipguard.thread_priority import set_realtime_priority

if TYPE_CHECKING:
    from rich.console import Console

    from slipguard.bench.wire_latency import LatencyReport


def latency(
    commands: Annotated[int, typer.Option(min=2, max=220, help="Number of commands to measure.")] = 200,
    fps: Annotated[Literal["60", "30"], typer.Option(help="Rate of the emulated cameras.")] = "60",
    baud: Annotated[int, typer.Option(min=0, help="Baud rate of the serial line; 0: unlimited.")] = 115200,
    as_service: Annotated[
        bool, typer.Option("--as-service", help="Use the real-time priority of the service; needs root.")
    ] = False,
    json: JsonOption = False,
) -> None:
    """Measure the latency from a frame's time stamp to the last byte of the command on the serial line, by stage.

    Runs the daemon and the gripper driver with an emulated cell for about a minute. No frame is skipped. Rendering the
    camera images takes part of this machine's time.

    Example: `slipguard latency --commands 100`
    """
    import json as jsonlib
    import logging
    from dataclasses import asdict

    from rich.console import Console

    from slipguard.bench.wire_latency import LatencyOptions, measure
    from slipguard.daemon import log_setup as log

    log.configure(level=logging.CRITICAL)
    if as_service:
        set_realtime_priority()
    with progress_bar("latency") as show, default_interrupts():
        found = asyncio.run(measure(LatencyOptions(commands=commands, baud=baud, fps=int(fps)), show))
    if json:
        print(jsonlib.dumps(asdict(found)))
    else:
        _print_table(Console(highlight=False), found)


def _print_table(console: Console, found: LatencyReport) -> None:
    from rich.table import Table

    from slipguard.bench.wire_latency import OWN, TOTAL

    options = found.options
    bit_rate = f"{options.baud} Bd" if options.baud else "unlimited baud rate"
    table = Table("stage, ms", title=f"{found.commands} commands, {options.fps} fps, {bit_rate}", title_justify="left")
    for name in ("p50", "p99", "largest"):
        table.add_column(name, justify="right")
    for stage, spread in found.stages.items():
        if stage == TOTAL:
            table.add_section()
        style = "bold" if stage in (TOTAL, OWN) else ""
        table.add_row(stage, f"{spread.p50_ms:.1f}", f"{spread.p99_ms:.1f}", f"{spread.largest_ms:.1f}", style=style)
    console.print(table)
