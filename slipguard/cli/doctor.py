"""`slipguard doctor`: check machine, daemon and devices, and say what to do about each problem."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from slipguard.cli.interrupt import default_interrupts
from slipguard.cli.options import USUAL_FILE, ConfigOption, JsonOption, SocketOption

if TYPE_CHECKING:
    from rich.console import Console

    from slipguard.doctor.run_checks import SubjectCheck

MARKS = {"ok": "[green]✓[/]", "note": "[yellow]![/]", "problem": "[red]✗[/]"}


def doctor(
    config: ConfigOption = USUAL_FILE,
    socket: SocketOption = None,
    json: JsonOption = False,
) -> None:
    """Check every device, link and permission, and say what to do. Nothing moves.

    Uses a running daemon; opens the devices itself only if none runs: as root with the rights of the installed service.
    Exits 1 if there is a problem.

    Example: `slipguard doctor --config config.toml`
    """
    import json as jsonlib
    import logging

    from rich.console import Console

    from slipguard.config import read_config
    from slipguard.daemon import log_setup as log
    from slipguard.daemon.api.paths import is_listening, running_socket
    from slipguard.doctor import as_service
    from slipguard.doctor.run_checks import run_checks
    from slipguard.errors import SlipguardError

    settings = read_config(config)
    log.configure(level=logging.CRITICAL)
    progress = Console(stderr=True, quiet=not Console(stderr=True).is_terminal)
    with progress.status("checking …") as status, default_interrupts():
        at = socket or running_socket(settings)
        checks: list[SubjectCheck] = []
        try:
            if as_service.is_possible(config) and not is_listening(at):
                checks = as_service.run_checks_as_service(config)
        except SlipguardError as error:
            checks = [as_service.not_as_service(str(error))]
        if len(checks) < 2:
            report = asyncio.run(run_checks(settings, at, lambda subject: status.update(f"checking {subject} …")))
            checks += report
    problems = sum(one.result.status == "problem" for one in checks)
    if json:
        print(jsonlib.dumps({"problems": problems, "checks": [_as_dict(one) for one in checks]}))
    else:
        _print(Console(highlight=False), checks, problems, config)
    if problems:
        raise typer.Exit(1)


def _as_dict(one: SubjectCheck) -> dict[str, str]:
    result = one.result
    return {
        "subject": one.subject,
        "check": result.check,
        "status": result.status.value,
        "observed": result.observed,
        "action": result.action,
    }


def _print(console: Console, checks: list[SubjectCheck], problems: int, config: Path) -> None:
    from rich.markup import escape
    from rich.table import Table

    table = Table.grid(padding=(0, 2, 0, 0))
    table.add_column(style="bold", no_wrap=True)
    table.add_column(no_wrap=True)
    table.add_column(no_wrap=True)
    table.add_column()
    before = ""
    for one in checks:
        result = one.result
        if before and one.subject != before:
            table.add_row()
        action = f"\n[bold]→ {escape(result.action)}[/]" if result.action else ""
        subject = one.subject if one.subject != before else ""
        table.add_row(subject, MARKS[result.status], escape(result.check), escape(result.observed) + action)
        before = one.subject
    console.print(table)
    notes = sum(one.result.status == "note" for one in checks)
    console.print()
    if problems:
        summary = f"[red]{problems} problem{'s' if problems > 1 else ''}[/], {notes} notes"
        console.print(f"{summary}; fix what is marked ✗ and run the doctor again", soft_wrap=True)
    else:
        console.print(f"no problems, {notes} notes: {escape(str(config))}", soft_wrap=True)
