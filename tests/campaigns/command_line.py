"""The campaigns' command line. A campaign's module is imported by its command only: some need torch."""

from __future__ import annotations

import json as jsonlib
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from slipguard.cli import app as product
from tests.campaigns.faults.command import faults
from tests.campaigns.fuzz import fuzz
from tests.campaigns.hostile_clients import hostile_clients
from tests.campaigns.paper_networks.recipe import Arch, RecipeName
from tests.campaigns.soak import soak

app = typer.Typer(name="campaigns", add_completion=False, pretty_exceptions_enable=False, rich_markup_mode="markdown")
for campaign in (soak, faults, hostile_clients, fuzz):
    app.command()(campaign)
Model = Annotated[Path | None, typer.Option(help="Segmentation network (.onnx); default: the shipped one.")]


@app.callback()
def top() -> None:
    """Run a long measurement. It is not part of the installed package.

    Example: `python -m tests.campaigns soak --hours 8`, `python -m tests.campaigns faults --runs 1000`
    """


@app.command()
def fit_sigma(
    grasps: Annotated[int, typer.Option(min=1, help="Rendered grasps of each training object and effect.")] = 1,
    model: Model = None,
) -> None:
    """Fit the constants of the rotation's sigma to rotations of known size.

    Run it again when the network, the renderer or the registration has changed. The constants are in
    `slipguard/perception/registration.py` and `gel_memory.py`.

    Example: `python -m tests.campaigns fit-sigma --grasps 2`
    """
    from tests.campaigns.fit_sigma import fit_and_report

    fit_and_report(grasps, model)


@app.command()
def network_table(
    models: Annotated[list[Path], typer.Argument(help="ONNX files that keep the model contract.")],
    grasps: Annotated[int, typer.Option(min=1, help="Grasps of each test object.")] = 2,
    lifts: Annotated[
        Path | None, typer.Option(help="Use the frames of this `slipguard evaluate run --sim` instead of grasps.")
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print one JSON object per network.")] = False,
) -> None:
    """Compare networks on rendered grasps of the test objects, or on recorded lifts: Dice, IoU, time, false contacts.

    Example: `python -m tests.campaigns network-table models/*.onnx`
    """
    from slipguard.perception.segmenter import Segmenter
    from tests.campaigns.network_table import HEADER, compare_networks, grasp_frames, recorded_frames

    networks = [(path.stem, Segmenter(path)) for path in models]
    rows = compare_networks(networks, recorded_frames(lifts) if lifts else grasp_frames(range(grasps)))
    if json:
        for row in rows:
            print(jsonlib.dumps(asdict(row)))
        return
    print(f"{rows[0].frames} frames with contact, {rows[0].untouched} without")
    print(HEADER, *rows, sep="\n")


@app.command()
def make_timing_network(path: Annotated[Path, typer.Argument(help="The .onnx file to write.")]) -> None:
    """Write the network with the layers of the paper's and arbitrary weights, which `slipguard bench` times.

    Needs the package onnx (`pip install 'slipguard[train]'`).

    Example: `python -m tests.campaigns make-timing-network models/peer-deeplabv3plus-resnet18-timing.onnx`
    """
    from tests.campaigns.timing_network import write_timing_network

    write_timing_network(path)


@app.command()
def rotated_presses(
    folder: Annotated[Path, typer.Argument(help="Folder with taxim_sphere/ and anytouch2_force2/.")],
    part: Annotated[str, typer.Option(help="Presses to rotate: tune, test or all.")] = "test",
    model: Model = None,
    json: Annotated[bool, typer.Option("--json", help="Print one JSON object per data set and method.")] = False,
) -> None:
    """Rotate images of real presses by known angles and measure the error of the estimates.

    Semi-synthetic: the images are from a real sensor, the rotation is computed. With `relit` the illumination stays
    fixed, as on a real sensor; with `rigid` it rotates with the press, which makes the task easier.

    Example: `python -m tests.campaigns rotated-presses real_digit/ --part test --json`
    """
    from slipguard.perception.segmenter import Segmenter
    from tests.campaigns.rotated_presses import ROTATION_METHODS, measure_presses, press_statistics

    segmenter = Segmenter(model)
    for method in ROTATION_METHODS:
        for row in press_statistics(measure_presses(folder, part, method, segmenter), method):
            print(jsonlib.dumps(asdict(row)) if json else row)


@app.command()
def train_paper_network(
    arch: Annotated[Arch, typer.Argument(help="Network to train.")],
    recipe: Annotated[RecipeName, typer.Option(help="Training settings.")] = RecipeName.paper,
    out: Annotated[Path | None, typer.Option(help="ONNX file to write. Default: models/ARCH-resnet18.onnx.")] = None,
    data: Annotated[
        Path | None, typer.Option(help="Data set to train on instead of rendered frames; see `slipguard dataset`.")
    ] = None,
    frames: Annotated[int | None, typer.Option(min=64, help="Number of rendered frames. Default: 3675.")] = None,
    epochs: Annotated[int | None, typer.Option(min=1, help="Epochs. Default: those of the recipe.")] = None,
    batch: Annotated[int | None, typer.Option(min=2, help="Batch size. Default: that of the recipe.")] = None,
    rate: Annotated[
        float | None, typer.Option(min=1e-6, max=1.0, help="Maximum learning rate. Default: that of the recipe.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Random seed.")] = 0,
    threshold: Annotated[float, typer.Option(min=0.05, max=0.95, help="Minimum probability of a contact pixel.")] = 0.5,
    threads: Annotated[int, typer.Option(min=1, help="Number of torch threads.")] = 2,
    bfloat16: Annotated[bool, typer.Option(help="Use bfloat16, where the processor supports it.")] = False,
    start: Annotated[Path | None, typer.Option(help="Start from the weights.pt of an earlier training.")] = None,
    encoder_weights: Annotated[
        Path | None, typer.Option(help="Initial weights of the ResNet18 encoder. Default: random.")
    ] = None,
    work: Annotated[
        Path, typer.Option(help="Folder for the checkpoint and the weights. A stopped training is continued.")
    ] = Path("build/train"),
    cluster: Annotated[str | None, typer.Option(help="Dask scheduler to render on: tcp://HOST:8786.")] = None,
) -> None:
    """Train one of the networks of the paper and export it as ONNX, to compare with.

    Needs `pip install 'slipguard[train]'`.

    Example: `python -m tests.campaigns train-paper-network deeplabv3plus --recipe short --bfloat16`
    """
    from tests.campaigns.paper_networks.command import PaperTrainingOptions, train_paper

    changed = {key: value for key, value in (("epochs", epochs), ("batch", batch), ("rate", rate)) if value}
    out = out or Path(f"models/{arch.value}-resnet18.onnx")
    train_paper(
        PaperTrainingOptions(
            arch.value, recipe.value, changed, out, work, frames, data, start, encoder_weights, bfloat16, seed,
            threads, threshold, cluster,
        )
    )  # fmt: skip


def run(arguments: list[str] | None = None) -> int:
    """Run one campaign and return its exit code; expected failures are one line on stderr."""
    return product.run(arguments, app, "python -m tests.campaigns")
