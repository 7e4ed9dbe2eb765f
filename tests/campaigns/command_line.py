"""The campaigns' commands on one typer application."""

from __future__ import annotations

import typer

from slipguard.cli import app as product
from tests.campaigns.api_load_command import api_load
from tests.campaigns.faults.command import faults
from tests.campaigns.soak.command import soak

app = typer.Typer(name="campaigns", add_completion=False, pretty_exceptions_enable=False, rich_markup_mode="markdown")
app.command()(soak)
app.command()(faults)
app.command()(api_load)


@app.callback()
def top() -> None:
    """Run a long measurement. None of this is part of the installed package.

    Example: `python -m tests.campaigns soak --hours 8`, `python -m tests.campaigns faults --runs 1000`
    """


def run(arguments: list[str] | None = None) -> int:
    """Run one campaign and return its exit code; expected failures are one line on stderr."""
    return product.run(arguments, app, "python -m tests.campaigns")
