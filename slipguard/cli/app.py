"""All commands on one typer application; `slipguard --sim` is the application without a command."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import click
import typer

from slipguard.cli import bench, ctl, dataset, guard, measure, simulate, train
from slipguard.errors import CommandRefused, ConfigError, InputError, ModelError, SlipguardError

app = typer.Typer(
    name="slipguard",
    help="Keeps a robot from dropping what it holds: DIGIT tactile images in, grip force out.",
    no_args_is_help=False,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
)
app.command()(guard.run)
app.command()(guard.check)
app.command()(guard.calibrate)
app.add_typer(ctl.app, name="ctl")
app.command()(measure.measure)
app.command()(bench.bench)
app.command()(train.train)
app.add_typer(dataset.app, name="dataset")
app.command()(guard.version)


@app.callback(invoke_without_command=True)
def top(
    context: typer.Context,
    sim: Annotated[
        bool, typer.Option("--sim", help="Run a whole grasp-and-lift campaign on the fakes.")
    ] = False,
    seed: Annotated[int, typer.Option(min=0, help="With --sim: seed of all that is random.")] = 0,
    lifts: Annotated[
        int | None, typer.Option(help="With --sim: how many lifts; default one per test object.")
    ] = None,
    guarded: Annotated[
        bool,
        typer.Option(
            "--guard/--no-guard", help="With --sim: without the guard, to see what it is for."
        ),
    ] = True,
    json: Annotated[
        bool, typer.Option("--json", help="With --sim: JSON lines, the summary last.")
    ] = False,
    out: Annotated[
        Path | None, typer.Option(help="With --sim: folder for the picture and the table.")
    ] = None,
    speed: Annotated[
        simulate.Speed,
        typer.Option(help="With --sim: on the real clock, or as fast as it computes."),
    ] = simulate.Speed.realtime,
) -> None:
    """Keeps a robot from dropping what it holds.

    Example: `slipguard --sim`, `slipguard run --config config.toml`, `slipguard measure frames/ --background bg.png`
    """
    if context.invoked_subcommand is not None:
        if sim:
            raise click.UsageError(
                "--sim before a command has no meaning; write `slipguard run --config FILE --sim`"
            )
        return
    if not sim:
        typer.echo(context.get_help())
        raise typer.Exit(0)
    simulate.simulate(seed=seed, lifts=lifts, guarded=guarded, json=json, out=out, speed=speed)


def run(arguments: list[str] | None = None) -> int:
    """Run one command and return its exit code; expected failures are one line on stderr."""
    command = typer.main.get_command(app)
    try:
        result = command.main(args=arguments, prog_name="slipguard", standalone_mode=False)
    except click.exceptions.Exit as finished:
        return finished.exit_code
    except click.ClickException as misuse:
        misuse.show()
        return 2
    except click.Abort:
        print("slipguard: interrupted", file=sys.stderr)
        return 1
    except (ConfigError, InputError, ModelError) as error:
        print(f"slipguard: {error}", file=sys.stderr)
        return 2
    except CommandRefused as error:
        print(f"slipguard: refused: {error}", file=sys.stderr)
        return 1
    except SlipguardError as error:
        print(f"slipguard: {error}", file=sys.stderr)
        return 1
    return result if isinstance(result, int) else 0
