"""`slipguard train`: train a segmentation network on rendered frames or a data set."""

from __future__ import annotations

import importlib.util
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from slipguard.errors import InputError

if TYPE_CHECKING:
    from slipguard.training.small_network import SmallNet
    from slipguard.training.train import EpochFigures


class Network(StrEnum):
    """The shipped network, and the three networks of the paper."""

    small = "small"
    deeplabv3plus = "deeplabv3plus"
    pspnet = "pspnet"
    unetplusplus = "unetplusplus"


class RecipeName(StrEnum):
    """Training of the paper's networks: as published, or shorter, at 120x160, for a CPU."""

    paper = "paper"
    short = "short"


VALIDATION_FRAMES = 400
SMALL, PAPER = "The small network", "The paper's networks"
"""Panels of the help."""


def train(
    arch: Annotated[Network, typer.Option(help="Network to train.")] = Network.small,
    out: Annotated[
        Path | None, typer.Option(help="ONNX file to write. Default: models/, named after the network.")
    ] = None,
    backgrounds: Annotated[
        Path | None,
        typer.Option(
            help="Folder of real background images (240x320), used for half of the frames.",
            rich_help_panel=SMALL,
        ),
    ] = None,
    validate: Annotated[
        Path | None,
        typer.Option(help="Folder of labeled real frames to evaluate after every epoch.", rich_help_panel=SMALL),
    ] = None,
    frames: Annotated[
        int | None,
        typer.Option(min=64, help="Number of rendered training frames. Default: 32000; the paper's networks: 3675."),
    ] = None,
    validation_frames: Annotated[
        int, typer.Option(min=10, help="Number of rendered validation frames.", rich_help_panel=SMALL)
    ] = VALIDATION_FRAMES,
    epochs: Annotated[int | None, typer.Option(min=1, help="Epochs. Default: 6, or those of the recipe.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Random seed.")] = 0,
    batch: Annotated[int | None, typer.Option(min=2, help="Batch size. Default: 32, or that of the recipe.")] = None,
    rate: Annotated[
        float | None,
        typer.Option(min=1e-6, max=1.0, help="Maximum learning rate of Adam. Default: 0.003, or that of the recipe."),
    ] = None,
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
        Path, typer.Option(help="Folder for rendered frames and the checkpoint. A stopped training is continued.")
    ] = Path("build/train"),
    recipe: Annotated[
        RecipeName | None, typer.Option(help="Training settings. Default: those of the paper.", rich_help_panel=PAPER)
    ] = None,
    data: Annotated[
        Path | None,
        typer.Option(
            help="Data set to train on instead of rendered frames; see `slipguard dataset`.", rich_help_panel=PAPER
        ),
    ] = None,
    encoder_weights: Annotated[
        Path | None,
        typer.Option(help="Initial weights of the ResNet18 encoder. Default: random.", rich_help_panel=PAPER),
    ] = None,
    int8: Annotated[
        bool, typer.Option("--int8", help="Also write an int8 file, and evaluate both.", rich_help_panel=PAPER)
    ] = False,
    cluster: Annotated[
        str | None, typer.Option(help="Dask scheduler to render on: tcp://HOST:8786.", rich_help_panel=PAPER)
    ] = None,
) -> None:
    """Train a segmentation network and export it as ONNX.

    Example: `slipguard train --out models/tsnn-small.onnx --work /tmp/train`,
    `slipguard train --arch deeplabv3plus --recipe short --bfloat16`
    """
    missing = [name for name in ("torch", "onnx") if importlib.util.find_spec(name) is None]
    if missing:
        raise InputError(
            f"training needs {' and '.join(missing)}; install with: pip install 'slipguard[train]' "
            "--extra-index-url https://download.pytorch.org/whl/cpu"
        )
    of_small = (backgrounds, validate, validation_frames != VALIDATION_FRAMES)
    of_paper = (recipe, data, encoder_weights, int8, cluster)
    if arch is Network.small and any(of_paper):
        raise InputError(
            "--recipe, --data, --encoder-weights, --int8 and --cluster are only for the paper's networks; "
            "choose one with --arch, such as deeplabv3plus"
        )
    if arch is not Network.small and any(of_small):
        raise InputError(f"--backgrounds, --validate and --validation-frames are for --arch small, not {arch.value}")
    if arch is not Network.small:
        from slipguard.cli.train_paper import PaperTrainingOptions, train_paper

        changed = {key: value for key, value in (("epochs", epochs), ("batch", batch), ("rate", rate)) if value}
        train_paper(
            PaperTrainingOptions(
                arch=arch.value,
                recipe=(recipe or RecipeName.paper).value,
                changed=changed,
                out=out or Path(f"models/{arch.value}-resnet18.onnx"),
                work=work,
                frames=frames,
                data=data,
                start=start,
                encoder_weights=encoder_weights,
                int8=int8,
                bfloat16=bfloat16,
                seed=seed,
                threads=threads,
                threshold=threshold,
                cluster=cluster,
            )
        )
        return
    out = out or Path("models/tsnn-small.onnx")
    frames, epochs, batch, rate = frames or 32000, epochs or 6, batch or 32, rate or 3e-3
    from rich.console import Console

    from slipguard.cli.train_paper import training_progress
    from slipguard.datasets.dataset_files import read_backgrounds
    from slipguard.datasets.frame_cache import VALIDATION_SEED, rendered_frames
    from slipguard.datasets.mask_scores import real_frames
    from slipguard.training.onnx_export import export_small, small_metadata
    from slipguard.training.train import TrainSettings, real_scores
    from slipguard.training.train import train as fit

    console = Console()
    real = [frame for frame in real_frames(validate) if frame.split == "tune"] if validate else []
    real_backgrounds = read_backgrounds(backgrounds) if backgrounds else None
    if start is not None and not start.is_file():
        raise InputError(
            f"--start {start}: no such file; give the weights.pt in the work folder of an earlier training"
        )
    settings = TrainSettings(epochs, batch, rate, seed, threads, threshold, bfloat16=bfloat16)
    work.mkdir(parents=True, exist_ok=True)
    with training_progress(console) as progress:
        rendering = progress.add_task("rendering", total=frames)
        rendering_validation = progress.add_task("rendering for validation", total=validation_frames)
        training = progress.add_task("training", total=None)
        shown = rendered_frames(work, seed * frames, frames, lambda done: progress.update(rendering, completed=done))
        held_out = rendered_frames(
            work,
            VALIDATION_SEED,
            validation_frames,
            lambda done: progress.update(rendering_validation, completed=done),
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
            real_backgrounds,
            start,
        )
    command = f"slipguard train --frames {frames} --epochs {epochs} --seed {seed} --batch {batch} --rate {rate:g}"
    if bfloat16:
        command += " --bfloat16"
    if start:
        command += " --start weights.pt"
    if real_backgrounds:
        command += f" --backgrounds ({len(real_backgrounds)} images)"
    metadata = small_metadata(command, seed, threshold)
    difference = export_small(net, out, metadata, held_out)
    size_kb = out.stat().st_size / 1000
    console.print(f"wrote {out} ({size_kb:.0f} kB); onnxruntime and torch differ by at most {difference:.1e}")
