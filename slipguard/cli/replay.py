"""`slipguard replay`: process recordings again, or export them to plain files."""

from __future__ import annotations

import json as jsonlib
from dataclasses import fields
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from slipguard.cli.options import JsonOption
from slipguard.errors import InputError, SlipguardError

if TYPE_CHECKING:
    from slipguard.control.messages import StepOutput
    from slipguard.tools.replay import CommandDifference, ControllerReplay, ReplayResult

DIFFERENCES_MAX = 10


class ExportFormat(StrEnum):
    """File format of an export."""

    csv = "csv"
    png = "png"
    mp4 = "mp4"


def replay(
    files: Annotated[list[Path], typer.Argument(help="Recordings (.mcap), or a folder of them.")],
    model: Annotated[Path | None, typer.Option(help="Segmentation network (.onnx). Default: the shipped one.")] = None,
    against: Annotated[
        bool,
        typer.Option(
            "--against", help="List commands that differ from the recorded ones; exit code 1 if there are any."
        ),
    ] = False,
    export: Annotated[
        Path | None,
        typer.Option(help="Export to this folder instead, with configuration and background images."),
    ] = None,
    kinds: Annotated[
        list[ExportFormat] | None, typer.Option("--as", help="With --export: csv, png or mp4; may be repeated.")
    ] = None,
    json: JsonOption = False,
) -> None:
    """Process recordings again: the frames by the perception, the recorded estimates by the controller.

    With the recorded estimates, the controller must give the same commands. With the frames, it does so if they were
    recorded as png; jpeg changes rotations by some hundredths of a degree.

    Example: `slipguard replay kept/20261121T143012.250Z.mcap --against`, `slipguard replay kept/ --export out/`
    """
    from rich.console import Console

    from slipguard.tools import replay as tool

    opened = tool.recordings(files)
    if export is not None:
        if model is not None or against:
            raise InputError("--export cannot be combined with --model and --against")
        from slipguard.tools.replay_export import export as export_files

        written = export_files(opened, export, {kind.value for kind in kinds or [ExportFormat.csv]})
        for path in written:
            print(path)
        return
    if kinds:
        raise InputError("--as needs --export FOLDER")
    done = tool.replay(opened, model)
    if not done.on_recorded.ticks and done.damage:
        raise SlipguardError(f"{done.damage[0]}; no control step could be read")
    if against and not done.on_recorded.ticks:
        raise SlipguardError("the recordings have no control steps, so nothing was compared")
    if model is not None and not done.estimates.processed:
        raise SlipguardError(f"--model {model}: no frame was processed, so the network was not used")
    if json:
        print(jsonlib.dumps(_as_json(done)))
    else:
        _print_result(Console(), done, against)
    if against and (done.on_recorded.differences or done.on_frames.differences):
        raise typer.Exit(1)


def _as_json(done: ReplayResult) -> dict[str, Any]:
    return {
        "ticks": done.on_recorded.ticks,
        "commands_differ": done.on_recorded.differ,
        "first_difference": _first(done.on_recorded),
        "frames": done.estimates.frames,
        "frames_replayed": done.estimates.processed,
        "image": done.image,
        "estimates_differ": done.estimates.differ,
        "turn_difference_max_deg": done.estimates.rotation_difference_max_deg,
        "commands_differ_on_frames": done.on_frames.differ,
        "first_difference_on_frames": _first(done.on_frames),
        "phases": [{"at_s": at_s, "phase": phase} for at_s, phase in done.phases],
        "faults": done.faults,
        "damage": done.damage,
    }


def _first(replayed: ControllerReplay) -> dict[str, Any] | None:
    return _plain(replayed.differences[0]) if replayed.differences else None


def _plain(difference: CommandDifference) -> dict[str, Any]:
    return {
        "at_s": difference.now_s,
        "recorded": _command_text(difference.recorded),
        "replayed": _command_text(difference.replayed),
    }


def _command_text(output: StepOutput) -> str:
    """Return only the fields that are set."""
    given = {one.name: getattr(output, one.name) for one in fields(output) if one.compare}
    return ", ".join(f"{name}={value}" for name, value in given.items() if value not in (None, False)) or "nothing"


def _print_result(console: Any, done: ReplayResult, against: bool) -> None:
    from rich.table import Table

    began_s = done.phases[0][0] if done.phases else 0.0
    way = ", ".join(f"{phase} {at_s - began_s:.1f} s" for at_s, phase in done.phases)
    console.print(f"{done.on_recorded.ticks} control steps: {way or 'none'}")
    for fault in done.faults:
        console.print(f"fault: {fault}")
    table = Table("processed", "control steps", "commands that differ", "rotations that differ")
    table.add_row(
        "controller with the recorded estimates",
        str(done.on_recorded.ticks),
        str(done.on_recorded.differ),
        "",
    )
    largest_deg = done.estimates.rotation_difference_max_deg
    rotations_text = f"{done.estimates.differ} of {done.estimates.processed} frames" + (
        "" if largest_deg is None else f", by at most {largest_deg:.3f}°"
    )
    table.add_row(
        f"controller with the frames ({done.image})",
        str(done.on_frames.ticks),
        str(done.on_frames.differ),
        rotations_text,
    )
    console.print(table)
    if not done.estimates.processed:
        console.print(
            "no frame was processed: there are no images, or no reference was taken in the recording and in the files "
            "before it"
        )
    for damage in done.damage:
        console.print(f"{damage}: processed up to there")
    if against:
        for name, replayed in (("recorded estimates", done.on_recorded), ("frames", done.on_frames)):
            _print_differences(console, name, replayed, began_s)


def _print_differences(console: Any, name: str, replayed: ControllerReplay, began_s: float) -> None:
    for one in replayed.differences[:DIFFERENCES_MAX]:
        console.print(f"{name}, {one.now_s - began_s:.3f} s:")
        console.print(f"  recorded {_command_text(one.recorded)}\n  replayed {_command_text(one.replayed)}")
    if replayed.differ > DIFFERENCES_MAX:
        console.print(f"{name}: {replayed.differ - DIFFERENCES_MAX} more")
