"""`slipguard replay`: a recording through pipeline and law again, or out of MCAP into plain files."""

from __future__ import annotations

import json as jsonlib
from dataclasses import fields
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from slipguard.errors import InputError, SlipguardError

if TYPE_CHECKING:
    from slipguard.control.messages import Command
    from slipguard.tools.replay import CommandDifference, ControllerReplay, ReplayResult

SHOWN = 10


class Kind(StrEnum):
    """What a recording can be taken apart into."""

    csv = "csv"
    png = "png"
    mp4 = "mp4"


def replay(
    files: Annotated[list[Path], typer.Argument(help="Recordings (.mcap), or a folder of them.")],
    model: Annotated[Path | None, typer.Option(help="Another segmentation network (.onnx).")] = None,
    against: Annotated[
        bool,
        typer.Option(
            "--against", help="List the commands that differ from the recorded ones; exit code 1 if any does."
        ),
    ] = False,
    export: Annotated[Path | None, typer.Option(help="Folder to take the recording apart into instead.")] = None,
    kinds: Annotated[
        list[Kind] | None, typer.Option("--as", help="With --export: csv, png, mp4; may be given several times.")
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="One JSON object.")] = False,
) -> None:
    """Play recordings again: the same frames through the pipeline, the same sights through the law.

    On what was recorded of the fingers the law must give the very same commands. On the frames themselves it does so
    where they were recorded as png; jpeg moves turns by some hundredths of a degree.

    Example: `slipguard replay kept/20261121T143012.250Z.mcap --against`, `slipguard replay kept/ --export out/`
    """
    from rich.console import Console

    from slipguard.tools import replay as lab

    opened = lab.recordings(files)
    if export is not None:
        if model is not None or against:
            raise InputError("--export takes a recording apart; --model and --against play it again: one or the other")
        from slipguard.tools.replay_export import export as take_apart

        written = take_apart(opened, export, {kind.value for kind in kinds or [Kind.csv]})
        for path in written:
            print(path)
        return
    if kinds:
        raise InputError("--as belongs to --export FOLDER")
    done = lab.replay(opened, model)
    if json:
        print(jsonlib.dumps(_as_json(done)))
    else:
        _show(Console(), done, against)
    if against and (done.on_recorded.differences or done.on_frames.differences):
        raise typer.Exit(1)
    if against and not done.on_recorded.ticks:
        raise SlipguardError("nothing was played, so nothing was compared")
    if model is not None and not done.asked:
        raise SlipguardError(f"--model {model}: no frame was replayed, so it was not tried")


def _as_json(done: ReplayResult) -> dict[str, Any]:
    rotations = [abs(rotation) for rotation in done.turn_differences_deg]
    return {
        "ticks": done.on_recorded.ticks,
        "commands_differ": len(done.on_recorded.differences),
        "first_difference": _first(done.on_recorded),
        "frames": len(done.answers),
        "frames_replayed": len(done.asked),
        "image": done.image,
        "estimates_differ": done.estimates_differ,
        "turn_difference_max_deg": max(rotations) if rotations else None,
        "commands_differ_on_frames": len(done.on_frames.differences),
        "first_difference_on_frames": _first(done.on_frames),
        "phases": [{"at_s": at_s, "phase": phase} for at_s, phase in done.phases],
        "faults": done.faults,
        "damage": done.damage,
    }


def _first(law: ControllerReplay) -> dict[str, Any] | None:
    return _plain(law.differences[0]) if law.differences else None


def _plain(difference: CommandDifference) -> dict[str, Any]:
    return {"at_s": difference.now_s, "recorded": _told(difference.recorded), "replayed": _told(difference.replayed)}


def _told(command: Command) -> str:
    """Only what it commands."""
    given = {one.name: getattr(command, one.name) for one in fields(command) if one.compare}
    return ", ".join(f"{name}={value}" for name, value in given.items() if value not in (None, False)) or "nothing"


def _show(console: Any, done: ReplayResult, against: bool) -> None:
    from rich.table import Table

    began_s = done.phases[0][0] if done.phases else 0.0
    way = ", ".join(f"{phase} {at_s - began_s:.1f} s" for at_s, phase in done.phases)
    console.print(f"{done.on_recorded.ticks} turns of the loop: {way or 'none'}")
    for fault in done.faults:
        console.print(f"fault: {fault}")
    table = Table("replayed", "how many", "commands that differ", "turns that differ")
    table.add_row("law on the recorded sights", str(done.on_recorded.ticks), str(len(done.on_recorded.differences)), "")
    rotations = [abs(rotation) for rotation in done.turn_differences_deg]
    told = f"{done.estimates_differ} of {len(done.asked)} frames" + (
        f", by {max(rotations):.3f}° at most" if rotations else ""
    )
    table.add_row(
        f"law on the frames ({done.image})", str(done.on_frames.ticks), str(len(done.on_frames.differences)), told
    )
    console.print(table)
    if not done.asked:
        console.print("no frame was replayed: there are no pictures, or no new reference was taken in the recording")
    for damage in done.damage:
        console.print(f"{damage}: played up to there")
    if against:
        for name, law in (("recorded sights", done.on_recorded), ("frames", done.on_frames)):
            _list(console, name, law, began_s)


def _list(console: Any, name: str, law: ControllerReplay, began_s: float) -> None:
    for one in law.differences[:SHOWN]:
        console.print(f"{name}, {one.now_s - began_s:.3f} s:")
        console.print(f"  recorded {_told(one.recorded)}\n  replayed {_told(one.replayed)}")
    if len(law.differences) > SHOWN:
        console.print(f"{name}: {len(law.differences) - SHOWN} more")
