"""`slipguard train`: the segmentation network from rendered frames, in one command."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from slipguard.errors import InputError

if TYPE_CHECKING:
    from slipguard.lab.networks import SmallNet
    from slipguard.lab.train import EpochFigures


def train(
    out: Annotated[Path, typer.Option(help="The ONNX file to write.")] = Path("models/tsnn-small.onnx"),
    backgrounds: Annotated[
        Path | None,
        typer.Option(help="Folder of real no-contact images (240x320); half of the imprints are put on them."),
    ] = None,
    validate: Annotated[
        Path | None, typer.Option(help="Folder of labelled real frames to report on after every epoch.")
    ] = None,
    frames: Annotated[int, typer.Option(min=64, help="Rendered training frames.")] = 32000,
    validation_frames: Annotated[int, typer.Option(min=10, help="Rendered validation frames.")] = 400,
    epochs: Annotated[int, typer.Option(min=1, help="Passes over the frames.")] = 6,
    seed: Annotated[int, typer.Option(min=0, help="Seed of all that is random.")] = 0,
    batch: Annotated[int, typer.Option(min=2, help="Frames a step.")] = 32,
    rate: Annotated[float, typer.Option(min=1e-6, max=1.0, help="Highest learning rate of Adam.")] = 3e-3,
    threshold: Annotated[
        float, typer.Option(min=0.05, max=0.95, help="Probability from which a pixel counts as contact.")
    ] = 0.5,
    threads: Annotated[int, typer.Option(min=1, help="Threads torch may use.")] = 2,
    bfloat16: Annotated[
        bool, typer.Option(help="Half precision: half as long on a processor that has it, longer on others.")
    ] = False,
    start: Annotated[
        Path | None, typer.Option(help="Begin with the weights.pt that an earlier training left in its work folder.")
    ] = None,
    work: Annotated[
        Path, typer.Option(help="Folder for rendered frames and the checkpoint; a stopped run goes on from there.")
    ] = Path("build/train"),
) -> None:
    """Train the segmentation network on rendered frames and export it as ONNX.

    Example: `slipguard train --out models/tsnn-small.onnx --work /tmp/train`
    """
    missing = [name for name in ("torch", "onnx") if importlib.util.find_spec(name) is None]
    if missing:
        raise InputError(
            f"training needs {' and '.join(missing)}; install with: pip install 'slipguard[train]' "
            "--extra-index-url https://download.pytorch.org/whl/cpu"
        )
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    from slipguard.lab.export import contract_metadata, export_onnx
    from slipguard.lab.frame_cache import VALIDATION_SEED, rendered_frames
    from slipguard.lab.scores import backgrounds_in, real_frames
    from slipguard.lab.train import TrainSettings, real_scores
    from slipguard.lab.train import train as fit

    console = Console()
    real = [frame for frame in real_frames(validate) if frame.split == "tune"] if validate else []
    no_contact = backgrounds_in(backgrounds) if backgrounds else None
    if start is not None and not start.is_file():
        raise InputError(f"{start}: no such file; name the weights.pt of an earlier training's work folder")
    settings = TrainSettings(epochs, batch, rate, seed, threads, threshold, bfloat16=bfloat16)
    work.mkdir(parents=True, exist_ok=True)
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console) as progress:
        drawing = progress.add_task("rendering", total=frames)
        checking = progress.add_task("rendering for validation", total=validation_frames)
        training = progress.add_task("training", total=None)
        shown = rendered_frames(work, seed * frames, frames, lambda done: progress.update(drawing, completed=done))
        held_out = rendered_frames(
            work,
            VALIDATION_SEED,
            validation_frames,
            lambda done: progress.update(checking, completed=done),
        )

        def on_epoch(figures: EpochFigures, net: SmallNet) -> None:
            line = (
                f"epoch {figures.epoch}: loss {figures.loss:.4f}, rendered Dice {figures.dice:.3f}, "
                f"IoU {figures.iou:.3f}, false contacts {figures.false_contact:.1%}"
            )
            scores = real_scores(net, real, threshold) if real else {}
            console.print(line + "".join(f", {group} IoU {value:.3f}" for group, value in scores.items()))

        net = fit(
            shown,
            held_out,
            settings,
            work,
            lambda done, total: progress.update(training, completed=done, total=total),
            on_epoch,
            no_contact,
            start,
        )
    command = f"slipguard train --frames {frames} --epochs {epochs} --seed {seed} --batch {batch} --rate {rate:g}"
    if bfloat16:
        command += " --bfloat16"
    if start:
        command += " --start weights.pt"
    if no_contact:
        command += f" --backgrounds ({len(no_contact)} images)"
    metadata = contract_metadata(command, seed, threshold)
    difference = export_onnx(net, out, metadata, held_out)
    size_kb = out.stat().st_size / 1000
    console.print(f"wrote {out} ({size_kb:.0f} kB); onnxruntime and torch differ by at most {difference:.1e}")
