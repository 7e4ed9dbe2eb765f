"""`slipguard train`: train the segmentation network on rendered frames or on a data set."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from slipguard.cli.terminal import progress_bars
from slipguard.errors import InputError

if TYPE_CHECKING:
    from slipguard.training.small_network import SmallNet
    from slipguard.training.train import EpochFigures


def train(
    out: Annotated[Path, typer.Option(help="ONNX file to write.")] = Path("models/tsnn-small.onnx"),
    data: Annotated[
        Path | None,
        typer.Option(help="Data set to train on instead of rendered frames; see `slipguard dataset`."),
    ] = None,
    backgrounds: Annotated[
        Path | None, typer.Option(help="Folder of real background images (240x320), used for half of the frames.")
    ] = None,
    validate: Annotated[Path | None, typer.Option(help="Data set to evaluate on after every epoch.")] = None,
    frames: Annotated[
        int,
        typer.Option(
            min=64,
            help="Number of rendered frames, of which the last tenth is held out; they take 140 kB of memory each.",
        ),
    ] = 24000,
    epochs: Annotated[int, typer.Option(min=1, help="Epochs.")] = 6,
    seed: Annotated[int, typer.Option(min=0, help="Random seed.")] = 0,
    batch: Annotated[int, typer.Option(min=2, help="Batch size.")] = 32,
    rate: Annotated[float, typer.Option(min=1e-6, max=1.0, help="Maximum learning rate of Adam.")] = 3e-3,
    threshold: Annotated[float, typer.Option(min=0.05, max=0.95, help="Minimum probability of a contact pixel.")] = 0.5,
    threads: Annotated[int, typer.Option(min=1, help="Number of torch threads.")] = 2,
    bfloat16: Annotated[
        bool, typer.Option(help="Use bfloat16: twice as fast on processors that support it, slower on others.")
    ] = False,
    start: Annotated[
        Path | None,
        typer.Option(help="Start from the weights.pt in the work folder of an earlier training."),
    ] = None,
    work: Annotated[
        Path, typer.Option(help="Folder for the checkpoint and the weights. A stopped training is continued.")
    ] = Path("build/train"),
) -> None:
    """Train the segmentation network and export it as ONNX.

    Example: `slipguard train --out models/tsnn-small.onnx --work /tmp/train`, `slipguard train --data recorded`
    """
    missing = [name for name in ("torch", "onnx") if importlib.util.find_spec(name) is None]
    if missing:
        raise InputError(
            f"training needs {' and '.join(missing)}; install with: pip install 'slipguard[train]' "
            "--extra-index-url https://download.pytorch.org/whl/cpu"
        )
    from rich.console import Console

    from slipguard.datasets.dataset_files import IMPORTED_LABEL, read_backgrounds
    from slipguard.sim.contact_label import LABEL_NAME
    from slipguard.training.augment import TrainingFrames
    from slipguard.training.onnx_export import export_small, model_metadata
    from slipguard.training.train import TrainSettings, scores
    from slipguard.training.train import train as fit

    console = Console()
    labeled = TrainingFrames.read(validate) if validate else None
    real_backgrounds = read_backgrounds(backgrounds) if backgrounds else None
    if start is not None and not start.is_file():
        raise InputError(
            f"--start {start}: no such file; give the weights.pt in the work folder of an earlier training"
        )
    settings = TrainSettings(epochs, batch, rate, seed, threads, threshold, bfloat16=bfloat16)
    work.mkdir(parents=True, exist_ok=True)
    with progress_bars() as add_bar:
        if data is None:
            rendered = TrainingFrames.rendered(seed * frames, frames, add_bar("rendering", frames))
        shown, held_out = (rendered if data is None else TrainingFrames.read(data)).split()

        def on_epoch(figures: EpochFigures, net: SmallNet) -> None:
            line = (
                f"epoch {figures.epoch}: loss {figures.loss:.4f}, held-out Dice {figures.dice:.3f}, "
                f"IoU {figures.iou:.3f}, false contacts {figures.false_contact:.1%}"
            )
            labeled_iou = scores(net, labeled, threshold)[1] if labeled else None
            console.print(line + (f", {validate} IoU {labeled_iou:.3f}" if labeled_iou is not None else ""))

        on_step = add_bar("training", None)
        net = fit(shown, held_out, settings, work, on_step, on_epoch, real_backgrounds, start)
    source = f"--frames {frames}" if data is None else f"--data ({len(shown)} frames)"
    command = f"slipguard train {source} --epochs {epochs} --seed {seed} --batch {batch} --rate {rate:g}"
    if bfloat16:
        command += " --bfloat16"
    if start:
        command += " --start weights.pt"
    if real_backgrounds:
        command += f" --backgrounds ({len(real_backgrounds)} images)"
    metadata = model_metadata(command, seed, threshold, LABEL_NAME if data is None else IMPORTED_LABEL)
    difference = export_small(net, out, metadata, held_out)
    size_kb = out.stat().st_size / 1000
    console.print(f"wrote {out} ({size_kb:.0f} kB); onnxruntime and torch differ by at most {difference:.1e}")
