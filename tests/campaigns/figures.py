"""What a campaign prints: its figures with their limits, as a table or as JSON. It exits 1 if a limit is exceeded."""

from __future__ import annotations

import json as jsonlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import typer
from rich.console import Console
from rich.table import Table


@dataclass(frozen=True, slots=True)
class Figure:
    """One value and its limit: an upper limit, or with `at_least` a lower limit; None: for information only."""

    what: str
    value: float
    limit: float | None = 0.0
    at_least: bool = False

    @property
    def good(self) -> bool:
        """Whether the value is within its limit; False for NaN."""
        if self.limit is None:
            return True
        return self.value >= self.limit if self.at_least else self.value <= self.limit


def report(figures: Sequence[Figure], details: Mapping[str, object], json: bool) -> None:
    """Print all figures and details. Raises typer.Exit(1) if a figure is not within its limit."""
    exceeded = [one.what for one in figures if not one.good]
    if json:
        print(jsonlib.dumps({one.what: one.value for one in figures} | {**details, "exceeded": exceeded}))
    else:
        console = Console(highlight=False)
        table = Table("", "found", "limit", "")
        for one in figures:
            limit = "" if one.limit is None else f"{'≥' if one.at_least else '≤'} {one.limit:.4g}"
            table.add_row(one.what, f"{one.value:.4g}", limit, "" if one.good else "[bold red]exceeded[/]")
        console.print(table)
        for name, value in details.items():
            console.print(f"{name}: {value}", markup=False)
    if exceeded:
        typer.echo(f"limit exceeded: {', '.join(exceeded)}", err=True)
        raise typer.Exit(1)
