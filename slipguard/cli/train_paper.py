"""`slipguard train --arch deeplabv3plus|pspnet|unetplusplus`: from frames to a checked ONNX file, with its curves."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress

    from slipguard.training.paper.frames import MaskedFrames
    from slipguard.training.paper.recipe import Recipe
    from slipguard.training.paper.training import PaperEpoch


@dataclass(frozen=True, slots=True)
class Request:
    """What was asked for. changed: fields of the recipe that the command line gives otherwise; frames: None, as many
    as the paper.
    """

    arch: str
    recipe: str
    changed: dict[str, Any]
    out: Path
    work: Path
    frames: int | None
    data: Path | None
    start: Path | None
    encoder_weights: Path | None
    int8: bool
    bfloat16: bool
    seed: int
    threads: int
    threshold: float
    cluster: str | None


def train_paper(asked: Request) -> None:
    """Train, export, check and measure; prints as it goes. Raises `InputError` and `ModelError` in one line."""
    import torch
    from rich.console import Console

    from slipguard.tools.parallel import Workers
    from slipguard.training.onnx_export import CALIBRATION_FRAMES, export_paper, paper_metadata, write_int8
    from slipguard.training.paper.networks import FrameNet
    from slipguard.training.paper.recipe import FRAMES, RECIPES, Arch
    from slipguard.training.paper.report import draw_curves, score_network
    from slipguard.training.paper.training import HISTORY, PaperTraining, choose_precision, train

    console = Console()
    recipe = replace(RECIPES[asked.recipe], **asked.changed)
    arch = Arch(asked.arch)
    torch.set_num_threads(asked.threads)
    torch.manual_seed(asked.seed)
    net = FrameNet(arch, recipe.height_px, recipe.width_px)
    if asked.encoder_weights is not None:
        net.start_encoder_from(asked.encoder_weights)
    if asked.start is not None:
        net.start_from(asked.start)
    precision = choose_precision(asked.bfloat16)
    work = asked.work / f"{arch.value}-{recipe.name}"
    work.mkdir(parents=True, exist_ok=True)
    with training_progress(console) as progress:
        shown, held_out = _frames(asked, recipe, FRAMES, Workers(cluster=asked.cluster), progress)
        encoder = asked.encoder_weights.name if asked.encoder_weights else "random"
        encoder = "an earlier training's" if asked.start else encoder
        settings = PaperTraining(arch, recipe, len(shown), asked.seed, encoder, precision.name)
        console.print(
            f"{arch.value}, recipe {recipe.name}: {len(shown)} frames of {recipe.width_px}x{recipe.height_px}, "
            f"{recipe.epochs} epochs, batch {recipe.batch}, Adam {recipe.rate:g} {recipe.schedule.value}, focal loss, "
            f"encoder from {encoder} weights; {precision.name} on {precision.device}"
        )
        training = progress.add_task("training", total=None)

        def on_epoch(epoch: PaperEpoch) -> None:
            console.print(
                f"epoch {epoch.number}: loss {epoch.loss:.4f}, held-out Dice {epoch.dice:.3f}, IoU {epoch.iou:.3f}, "
                f"{epoch.seconds:.0f} s"
            )

        history = train(
            net,
            settings,
            precision,
            shown,
            held_out,
            work,
            lambda done, total: progress.update(training, completed=done, total=total),
            on_epoch,
        )
    draw_curves(history, f"{arch.value}, {recipe.name}", work / "curves.png")
    console.print(f"figures of every epoch in {work / HISTORY}, curves in {work / 'curves.png'}")
    metadata = paper_metadata(
        _command(asked, len(shown)), asked.seed, asked.threshold, _label(asked), (recipe.width_px, recipe.height_px)
    )
    difference = export_paper(net, asked.out, metadata, held_out)
    size_mb = asked.out.stat().st_size / 1e6
    console.print(f"wrote {asked.out} ({size_mb:.1f} MB); onnxruntime and torch differ by at most {difference:.1e}")
    console.print(f"held out, {asked.out.name}: {score_network(asked.out, held_out, asked.threshold)}")
    if asked.int8:
        smaller = asked.out.with_name(f"{asked.out.stem}-int8.onnx")
        write_int8(asked.out, smaller, shown.sample(CALIBRATION_FRAMES))
        size_mb = smaller.stat().st_size / 1e6
        console.print(
            f"held out, {smaller.name} ({size_mb:.1f} MB): {score_network(smaller, held_out, asked.threshold)}"
        )


def training_progress(console: Console) -> Progress:
    """The bars of a training: rendering, then batches, with the time they take and still need."""
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    text, bar, count = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn()
    return Progress(text, bar, count, TimeElapsedColumn(), TimeRemainingColumn(), console=console)


def _frames(
    asked: Request, recipe: Recipe, usual: int, workers: Any, progress: Progress
) -> tuple[MaskedFrames, MaskedFrames]:
    from slipguard.training.paper.frames import read_masked_frames, render_masked_frames
    from slipguard.training.paper.recipe import HELD_OUT

    size_px = (recipe.width_px, recipe.height_px)
    if asked.data is not None:
        return read_masked_frames(asked.data, size_px)
    asked.work.mkdir(parents=True, exist_ok=True)
    parts = []
    for count, held_out in ((asked.frames or usual, False), (HELD_OUT, True)):
        drawing = progress.add_task("rendering held-out frames" if held_out else "rendering", total=count)

        def show(done: int, task: Any = drawing) -> None:
            progress.update(task, completed=done)

        parts.append(render_masked_frames(asked.work, count, size_px, held_out, workers, show))
    return parts[0], parts[1]


def _label(asked: Request) -> str:
    from slipguard.datasets.importer import LABEL_NAME as IMPORTED
    from slipguard.sim.contact_label import LABEL_NAME

    return LABEL_NAME if asked.data is None else IMPORTED


def _command(asked: Request, count: int) -> str:
    """How to make the network again, without this machine's paths."""
    words = [f"slipguard train --arch {asked.arch} --recipe {asked.recipe}"]
    words += [f"--{key} {value:g}" for key, value in asked.changed.items()]
    words += [f"--frames {asked.frames}"] if asked.frames is not None and asked.data is None else []
    words += [f"--data ({count} frames)"] if asked.data is not None else []
    words += ["--start weights.pt"] if asked.start is not None else []
    words += [f"--encoder-weights ({asked.encoder_weights.name})"] if asked.encoder_weights is not None else []
    words += ["--bfloat16"] if asked.bfloat16 else []
    return " ".join([*words, f"--seed {asked.seed}"])
