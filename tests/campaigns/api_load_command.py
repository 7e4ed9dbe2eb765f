"""`python -m tests.campaigns api-load`: what many clients of page and API cost the control loop."""

from __future__ import annotations

import asyncio
import json as jsonlib
import logging
from dataclasses import asdict
from typing import Annotated, Literal

import typer
from rich.console import Console
from rich.table import Table

from slipguard.cli.interrupt import default_interrupts
from slipguard.cli.progress import progress_bar
from slipguard.daemon import logging as log
from slipguard.errors import SlipguardError
from slipguard.thread_priority import set_realtime_priority
from tests.campaigns.api_load import ApiLoadOptions, measure_api_load


def api_load(
    clients: Annotated[int, typer.Option(min=1, max=60, help="Number of clients; half stream, half poll.")] = 50,
    pairs: Annotated[int, typer.Option(min=1, max=100, help="How often to alternate without and with clients.")] = 6,
    block_s: Annotated[float, typer.Option(min=0.5, max=600.0, help="Seconds of each block.")] = 8.0,
    fps: Annotated[Literal["60", "30"], typer.Option(help="Rate of the emulated cameras.")] = "60",
    as_service: Annotated[
        bool, typer.Option("--as-service", help="With the real-time priority of the service; needs root.")
    ] = False,
    json: Annotated[bool, typer.Option("--json", help="One JSON object.")] = False,
) -> None:
    """Compare the loop's latency without and with clients; exit 1 if they cost too much or were not served.

    Example: `python -m tests.campaigns api-load --clients 50`
    """
    options = ApiLoadOptions(clients, pairs, block_s, int(fps))
    log.configure(level=logging.CRITICAL)
    if as_service:
        set_realtime_priority()
    with progress_bar("API load") as show, default_interrupts():
        found = asyncio.run(measure_api_load(options, show))
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
