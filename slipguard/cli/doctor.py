"""`slipguard doctor`: a look at everything, a line for each thing, and what to do where one is wrong."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from slipguard.cli.interrupt import default_interrupts
from slipguard.cli.run import USUAL_FILE, ConfigOption

if TYPE_CHECKING:
    from rich.console import Console

    from slipguard.doctor.examine import Line

MARKS = {"ok": "[green]✓[/]", "note": "[yellow]![/]", "problem": "[red]✗[/]"}


def doctor(
    config: ConfigOption = USUAL_FILE,
    socket: Annotated[Path | None, typer.Option(help="Socket of a running daemon; default: found.")] = None,
    json: Annotated[bool, typer.Option("--json", help="One JSON object.")] = False,
) -> None:
    """Look at every device, link and permission and say what to do; move nothing.

    Asks the running daemon; opens the devices itself only when none runs. Exit code 1 where something is wrong.
    Example: `slipguard doctor --config config.toml`
    """
    import json as jsonlib
    import logging

    from rich.console import Console

    from slipguard.config import read_config
    from slipguard.daemon import log_setup as log
    from slipguard.daemon.api.paths import running_socket
    from slipguard.doctor.examine import examine

    settings = read_config(config)
    log.configure(level=logging.CRITICAL)
    progress = Console(stderr=True, quiet=not Console(stderr=True).is_terminal)
    with progress.status("looking …") as status, default_interrupts():
        lines = asyncio.run(
            examine(settings, socket or running_socket(settings), lambda check: status.update(f"looking at {check} …"))
        )
    bad = sum(line.result.status == "problem" for line in lines)
    if json:
        print(jsonlib.dumps({"problems": bad, "checks": [_plain(line) for line in lines]}))
    else:
        _show(Console(highlight=False), lines, bad, config)
    if bad:
        raise typer.Exit(1)


def _plain(line: Line) -> dict[str, str]:
    found = line.result
    return {
        "subject": line.subject,
        "check": found.check,
        "status": found.status.value,
        "observed": found.observed,
        "action": found.action,
    }


def _show(console: Console, lines: list[Line], bad: int, config: Path) -> None:
    from rich.markup import escape
    from rich.table import Table

    table = Table.grid(padding=(0, 2, 0, 0))
    table.add_column(style="bold", no_wrap=True)
    table.add_column(no_wrap=True)
    table.add_column(no_wrap=True)
    table.add_column()
    before = ""
    for line in lines:
        found = line.result
        if before and line.subject != before:
            table.add_row()
        action = f"\n[bold]→ {escape(found.action)}[/]" if found.action else ""
        name = line.subject if line.subject != before else ""
        table.add_row(name, MARKS[found.status], escape(found.check), escape(found.observed) + action)
        before = line.subject
    console.print(table)
    notes = sum(line.result.status == "note" for line in lines)
    console.print()
    if bad:
        console.print(f"[red]{bad} wrong[/], {notes} to note; mend what is marked ✗ and look again", soft_wrap=True)
    else:
        told = f"{notes} to note, " if notes else ""
        console.print(f"{told}nothing wrong with the cell of {escape(str(config))}", soft_wrap=True)
