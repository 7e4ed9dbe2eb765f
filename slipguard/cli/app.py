"""All commands on one typer application; `slipguard --sim` is the application without a command."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from slipguard.cli import (
    bench,
    calibrate,
    ctl,
    dataset,
    doctor,
    emulate,
    evaluate,
    install,
    latency,
    measure,
    replay,
    rotated_presses,
    simulate,
    stress,
    train,
)
from slipguard.cli import run as daemon
from slipguard.errors import CommandRefused, ConfigError, InputError, ModelError, SlipguardError

SIM_PANEL = "With --sim"
CTRL_C = 130
"""What typer makes of a KeyboardInterrupt."""
Misuse: type[Exception] = typer.BadParameter.__mro__[2]
"""Base of every complaint about a command line; the click that typer brings along has no public name."""

app = typer.Typer(name="slipguard", add_completion=False, pretty_exceptions_enable=False, rich_markup_mode="markdown")
app.command()(daemon.run)
app.command()(daemon.check)
app.command()(doctor.doctor)
app.command()(install.install)
app.command()(calibrate.calibrate)
app.add_typer(ctl.app, name="ctl")
app.command()(measure.measure)
app.command()(replay.replay)
app.command()(bench.bench)
app.command()(latency.latency)
app.command()(stress.stress)
app.command()(rotated_presses.rotated)
app.command()(train.train)
app.add_typer(evaluate.app, name="evaluate")
app.add_typer(dataset.app, name="dataset")
app.add_typer(emulate.app, name="emulate")
app.command()(daemon.version)


@app.callback(invoke_without_command=True)
def top(
    context: typer.Context,
    sim: Annotated[
        bool, typer.Option("--sim", help="Lift objects that would turn and fall, all simulated: about a minute.")
    ] = False,
    seed: Annotated[int, typer.Option(min=0, help="Seed of all that is random.", rich_help_panel=SIM_PANEL)] = 0,
    lifts: Annotated[
        int | None, typer.Option(help="How many lifts; default: one for each test object.", rich_help_panel=SIM_PANEL)
    ] = None,
    guarded: Annotated[
        bool,
        typer.Option("--guard/--no-guard", help="Without the guard, to see what it is for.", rich_help_panel=SIM_PANEL),
    ] = True,
    json: Annotated[
        bool, typer.Option("--json", help="JSON lines, the summary last.", rich_help_panel=SIM_PANEL)
    ] = False,
    out: Annotated[
        Path | None, typer.Option(help="Folder for a picture of every lift.", rich_help_panel=SIM_PANEL)
    ] = None,
    speed: Annotated[
        simulate.Speed,
        typer.Option(help="On the real clock, or as fast as it computes.", rich_help_panel=SIM_PANEL),
    ] = simulate.Speed.realtime,
) -> None:
    """Keeps a robot from dropping what it holds: DIGIT tactile images in, grip force out.

    Example: `slipguard --sim`, `slipguard run --config config.toml`, `slipguard measure frames/ --background bg.png`
    """
    if context.invoked_subcommand is not None:
        if sim:
            raise InputError("--sim before a command has no meaning; write `slipguard run --config FILE --sim`")
        return
    if not sim:
        if (seed, lifts, guarded, json, out, speed) != (0, None, True, False, None, simulate.Speed.realtime):
            raise InputError("these options belong to --sim; write `slipguard --sim ...`")
        typer.echo(context.get_help())
        return
    simulate.simulate(seed=seed, lifts=lifts, guarded=guarded, json=json, out=out, speed=speed)


def run(arguments: list[str] | None = None, app: typer.Typer = app, program: str = "slipguard") -> int:
    """Run one command and return its exit code; expected failures are one line on stderr."""
    command = typer.main.get_command(app)
    try:
        result = command.main(args=arguments, prog_name=program, standalone_mode=False)
    except typer.Exit as finished:
        return finished.exit_code
    except typer.Abort:
        return _complain("interrupted", 1)
    except Misuse as misuse:
        return _complain(_what_is_wrong(misuse), 2)
    except SlipguardError as error:
        return _complain(*_in_words(error))
    except ExceptionGroup as group:
        # A task group's: the first failure cancelled the others.
        expected, unexpected = group.split(SlipguardError)
        if unexpected is not None or expected is None:
            raise
        return _complain(*_in_words(_leaf(expected)))
    except BrokenPipeError:
        raise
    except OSError as error:
        # A full disk, a folder that cannot be written to: the file and the reason say it all.
        where = f"{error.filename}: " if error.filename else ""
        return _complain(f"{where}{error.strerror or error}", 1)
    if result == CTRL_C:
        return _complain("interrupted", 1)
    return result if isinstance(result, int) else 0


def _complain(text: str, code: int) -> int:
    if text:
        print(f"slipguard: {' '.join(text.split())}", file=sys.stderr)
    return code


def _in_words(error: BaseException) -> tuple[str, int]:
    """The line and the exit code of an expected failure."""
    if isinstance(error, CommandRefused):
        return f"refused: {error}", 1
    return str(error), 2 if isinstance(error, ConfigError | InputError | ModelError) else 1


def _leaf(group: BaseExceptionGroup[Any]) -> BaseException:
    first: BaseException = group
    while isinstance(first, BaseExceptionGroup):
        first = first.exceptions[0]
    return first


def _what_is_wrong(misuse: Any) -> str:
    """One line with the way to the help; nothing where the help has just been shown."""
    text = str(misuse.format_message()).replace("Value error, ", "").strip()
    if not text:
        return ""
    context = getattr(misuse, "ctx", None)
    path = context.command_path if context is not None else "slipguard"
    return f"{text[0].lower()}{text[1:].rstrip('.')}; see `{path} --help`"
