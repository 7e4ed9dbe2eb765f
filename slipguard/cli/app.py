"""All commands in one typer application; `slipguard --sim` is the application without a command."""

from __future__ import annotations

import json as jsonlib
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from slipguard.cli import (
    bench,
    calibrate,
    check,
    ctl,
    dataset,
    doctor,
    emulate,
    evaluate,
    install,
    measure,
    replay,
    simulate,
    stress,
    train,
)
from slipguard.cli import run as daemon
from slipguard.errors import CommandRefused, ConfigError, InputError, ModelError, SlipguardError

SIM_PANEL = "With --sim"
ROBOT, ANALYSIS, NETWORKS, CHECKS = "Robot cell", "Frames and recordings", "Networks and data", "Tests and benchmarks"
CTRL_C = 130
"""Result of a typer command after a KeyboardInterrupt."""
UsageError: type[Exception] = typer.BadParameter.__mro__[2]
"""Base class of all errors of usage; the click inside typer has no public name."""

app = typer.Typer(name="slipguard", add_completion=False, pretty_exceptions_enable=False, rich_markup_mode="markdown")
app.command(rich_help_panel=ROBOT)(daemon.run)
app.command(rich_help_panel=ROBOT)(check.check)
app.command(rich_help_panel=ROBOT)(doctor.doctor)
app.command(rich_help_panel=ROBOT)(install.install)
app.command(rich_help_panel=ROBOT)(calibrate.calibrate)
app.add_typer(ctl.app, name="ctl", rich_help_panel=ROBOT)
app.command(rich_help_panel=ANALYSIS)(measure.measure)
app.command(rich_help_panel=ANALYSIS)(replay.replay)
app.command(rich_help_panel=CHECKS)(bench.bench)
app.command(rich_help_panel=CHECKS)(stress.stress)
app.add_typer(evaluate.app, name="evaluate", rich_help_panel=CHECKS)
app.add_typer(emulate.app, name="emulate", rich_help_panel=CHECKS)
app.add_typer(dataset.app, name="dataset", rich_help_panel=NETWORKS)
app.command(rich_help_panel=NETWORKS)(train.train)
app.command()(daemon.version)


@app.callback(invoke_without_command=True)
def top(
    context: typer.Context,
    sim: Annotated[
        bool, typer.Option("--sim", help="Lift simulated objects that slip without the guard. About a minute.")
    ] = False,
    seed: Annotated[int, typer.Option(min=0, help="Random seed.", rich_help_panel=SIM_PANEL)] = 0,
    lifts: Annotated[
        int | None, typer.Option(help="Number of lifts. Default: one per test object.", rich_help_panel=SIM_PANEL)
    ] = None,
    guarded: Annotated[
        bool,
        typer.Option(
            "--guard/--no-guard", help="With or without the guard, for comparison.", rich_help_panel=SIM_PANEL
        ),
    ] = True,
    json: Annotated[
        bool, typer.Option("--json", help="Print JSON lines, the summary last.", rich_help_panel=SIM_PANEL)
    ] = False,
    out: Annotated[
        Path | None, typer.Option(help="Folder for a plot of every lift.", rich_help_panel=SIM_PANEL)
    ] = None,
    speed: Annotated[
        simulate.Speed,
        typer.Option(help="In real time, or as fast as the computer allows.", rich_help_panel=SIM_PANEL),
    ] = simulate.Speed.realtime,
) -> None:
    """Keeps a robot from dropping what it holds: DIGIT tactile images in, grip force out.

    Example: `slipguard --sim`, `slipguard run --config config.toml`, `slipguard measure frames/ --background bg.png`
    """
    if context.invoked_subcommand is not None:
        if sim:
            raise InputError("--sim before a command has no effect; use `slipguard run --config FILE --sim`")
        return
    if not sim:
        if (seed, lifts, guarded, json, out, speed) != (0, None, True, False, None, simulate.Speed.realtime):
            raise InputError("these options need --sim; use `slipguard --sim ...`")
        typer.echo(context.get_help())
        return
    simulate.simulate(seed=seed, lifts=lifts, guarded=guarded, json=json, out=out, speed=speed)


def run(arguments: list[str] | None = None, app: typer.Typer = app, program: str = "slipguard") -> int:
    """Run one command and return its exit code.

    An expected failure prints one line on stderr, and with --json also `{"error": line}` as the last line on stdout.
    """
    code, error = _run(arguments, app, program)
    line = " ".join(error.split())
    shown = error if sys.stderr is not None and sys.stderr.isatty() else line  # several mistakes: one in a line
    if line and "--json" in (sys.argv[1:] if arguments is None else arguments):
        print(jsonlib.dumps({"error": line}), flush=True)
    if line:
        from slipguard.daemon.journal import stderr_is_journal

        # The journal reads a priority at the start of a line (sd-daemon(3)); 3 is "error".
        priority = "<3>" if stderr_is_journal() else ""
        print(f"{priority}slipguard: {shown}", file=sys.stderr)
    return code


def _run(arguments: list[str] | None, app: typer.Typer, program: str) -> tuple[int, str]:
    """Run one command; return its exit code and the error, "" for none."""
    command = typer.main.get_command(app)
    try:
        result = command.main(args=arguments, prog_name=program, standalone_mode=False)
    except typer.Exit as finished:
        return finished.exit_code, ""
    except typer.Abort:
        return 1, "interrupted"
    except UsageError as error:
        return 2, _usage_message(error)
    except SlipguardError as error:
        return _code_and_message(error)
    except ExceptionGroup as group:
        # Of a task group: the first failure has cancelled the other tasks.
        expected, unexpected = group.split(lambda error: isinstance(error, SlipguardError) or _lacks(error) is not None)
        if unexpected is not None or expected is None:
            raise
        return _code_and_message(_first_exception(expected))
    except (RuntimeError, MemoryError) as error:
        if _lacks(error) is None:
            raise
        return _code_and_message(error)
    except BrokenPipeError:
        raise
    except OSError as error:
        # For example a full disk, or a folder without write permission.
        where = f"{error.filename}: " if error.filename else ""
        return 1, f"{where}{error.strerror or error}"
    if result == CTRL_C:
        return 1, "interrupted"
    return result if isinstance(result, int) else 0, ""


def _lacks(error: BaseException) -> str | None:
    """Return what the system has refused to this process, and what to do; None for any other error."""
    if isinstance(error, MemoryError):
        return "out of memory; raise the memory limit of this process, or end other programs"
    if isinstance(error, RuntimeError) and str(error) == "can't start new thread":
        return f"{error}; raise the limit of processes (`ulimit -u`, TasksMax), or end other programs"
    return None


def _code_and_message(error: BaseException) -> tuple[int, str]:
    lacking = _lacks(error)
    if lacking is not None:
        return 1, lacking
    if isinstance(error, CommandRefused):
        return 1, f"refused: {error}"
    return 2 if isinstance(error, ConfigError | InputError | ModelError) else 1, str(error)


def _first_exception(group: BaseExceptionGroup[Any]) -> BaseException:
    first: BaseException = group
    while isinstance(first, BaseExceptionGroup):
        first = first.exceptions[0]
    return first


def _usage_message(error: Any) -> str:
    """Return one line that names the help; empty if the help has just been shown."""
    text = str(error.format_message()).replace("Value error, ", "").strip()
    if not text:
        return ""
    context = getattr(error, "ctx", None)
    path = context.command_path if context is not None else "slipguard"
    return f"{text[0].lower()}{text[1:].rstrip('.')}; see `{path} --help`"
