"""`python -m tests.campaigns train-paper-network`: train and export a network of the paper."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tests.campaigns.paper_networks.frames import MaskedFrames
    from tests.campaigns.paper_networks.recipe import Recipe
    from tests.campaigns.paper_networks.training import PaperEpoch


@dataclass(frozen=True, slots=True)
class PaperTrainingOptions:
    """Options of the command line.

    changed: fields of the recipe that options override. frames: None for the number in the paper.
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
    bfloat16: bool
    seed: int
    threads: int
    threshold: float
    cluster: str | None


def train_paper(options: PaperTrainingOptions) -> None:
    """Train and export the network; prints the results. Raises InputError or ModelError."""
    import torch
    from rich.console import Console

    from slipguard.cli.terminal import progress_bars
    from slipguard.tools.parallel import Workers
    from slipguard.training.onnx_export import model_metadata
    from tests.campaigns.paper_networks.networks import FrameNet, export_paper
    from tests.campaigns.paper_networks.recipe import FRAMES, RECIPES, Arch
    from tests.campaigns.paper_networks.training import HISTORY, PaperTraining, choose_precision, train

    console = Console()
    recipe = replace(RECIPES[options.recipe], **options.changed)
    arch = Arch(options.arch)
    torch.set_num_threads(options.threads)
    torch.manual_seed(options.seed)
    net = FrameNet(arch, recipe.height_px, recipe.width_px)
    if options.encoder_weights is not None:
        net.start_encoder_from(options.encoder_weights)
    if options.start is not None:
        net.start_from(options.start)
    precision = choose_precision(options.bfloat16)
    work = options.work / f"{arch.value}-{recipe.name}"
    work.mkdir(parents=True, exist_ok=True)
    with progress_bars() as add_bar:
        shown, held_out = _frames(options, recipe, FRAMES, Workers(cluster=options.cluster), add_bar)
        encoder = options.encoder_weights.name if options.encoder_weights else "random"
        encoder = "an earlier training" if options.start else encoder
        settings = PaperTraining(arch, recipe, len(shown), options.seed, encoder, precision.name)
        console.print(
            f"{arch.value}, recipe {recipe.name}: {len(shown)} frames of {recipe.width_px}x{recipe.height_px}, "
            f"{recipe.epochs} epochs, batch {recipe.batch}, Adam {recipe.rate:g} {recipe.schedule.value}, focal loss, "
            f"encoder weights: {encoder}; {precision.name} on {precision.device}"
        )
        on_step = add_bar("training", None)

        def on_epoch(epoch: PaperEpoch) -> None:
            console.print(
                f"epoch {epoch.number}: loss {epoch.loss:.4f}, held-out Dice {epoch.dice:.3f}, IoU {epoch.iou:.3f}, "
                f"{epoch.seconds:.0f} s"
            )

        train(
            net,
            settings,
            precision,
            shown,
            held_out,
            work,
            on_step,
            on_epoch,
        )
    console.print(f"results of each epoch in {work / HISTORY}")
    metadata = model_metadata(
        _command(options, len(shown)),
        options.seed,
        options.threshold,
        _label(options),
        (recipe.width_px, recipe.height_px),
    )
    difference = export_paper(net, options.out, metadata, held_out.frame)
    size_mb = options.out.stat().st_size / 1e6
    console.print(f"wrote {options.out} ({size_mb:.1f} MB); onnxruntime and torch differ by at most {difference:.1e}")


def _frames(
    options: PaperTrainingOptions,
    recipe: Recipe,
    default_count: int,
    workers: Any,
    add_bar: Callable[..., Any],
) -> tuple[MaskedFrames, MaskedFrames]:
    from tests.campaigns.paper_networks.frames import read_masked_frames, render_masked_frames
    from tests.campaigns.paper_networks.recipe import HELD_OUT

    size_px = (recipe.width_px, recipe.height_px)
    if options.data is not None:
        return read_masked_frames(options.data, size_px)
    parts = []
    for count, held_out in ((options.frames or default_count, False), (HELD_OUT, True)):
        show = add_bar("rendering held-out frames" if held_out else "rendering", count)
        parts.append(render_masked_frames(count, size_px, held_out, workers, show))
    return parts[0], parts[1]


def _label(options: PaperTrainingOptions) -> str:
    from slipguard.datasets.dataset_files import IMPORTED_LABEL
    from slipguard.sim.contact_label import LABEL_NAME

    return LABEL_NAME if options.data is None else IMPORTED_LABEL


def _command(options: PaperTrainingOptions, count: int) -> str:
    """Return the command that reproduces the network, without paths of this machine."""
    words = [f"python -m tests.campaigns train-paper-network {options.arch} --recipe {options.recipe}"]
    words += [f"--{key} {value:g}" for key, value in options.changed.items()]
    words += [f"--frames {options.frames}"] if options.frames is not None and options.data is None else []
    words += [f"--data ({count} frames)"] if options.data is not None else []
    words += ["--start weights.pt"] if options.start is not None else []
    words += [f"--encoder-weights ({options.encoder_weights.name})"] if options.encoder_weights is not None else []
    words += ["--bfloat16"] if options.bfloat16 else []
    return " ".join([*words, f"--seed {options.seed}"])
