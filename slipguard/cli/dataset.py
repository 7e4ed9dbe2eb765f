"""`slipguard dataset render`: training and test images from the renderer."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

app = typer.Typer(no_args_is_help=True, rich_markup_mode="markdown")


class Split(StrEnum):
    """Which objects are pressed."""

    train = "train"
    test = "test"


@app.callback()
def dataset() -> None:
    """Rendered images with masks, to train on or to look at.

    Example: `slipguard dataset render --out frames --count 200 --show sheet.png`
    """


@app.command()
def render(
    out: Annotated[Path, typer.Option(help="Folder to write to: new or empty.")],
    count: Annotated[int, typer.Option(help="How many frames.")],
    seed: Annotated[int, typer.Option(help="The first frame's seed; the next ones count on from it.")] = 0,
    split: Annotated[
        Split, typer.Option(help="Training objects, or the test objects no network has seen.")
    ] = Split.train,
    backgrounds: Annotated[
        Path | None, typer.Option(help="Folder of real no-contact images, 240 wide x 320 high; half the units use one.")
    ] = None,
    show: Annotated[Path | None, typer.Option(help="Write a sheet of some frames to this PNG.")] = None,
) -> None:
    """Render frames with their no-contact images and masks, and a manifest.

    Example: `slipguard dataset render --out frames --count 200 --split test --show sheet.png`
    """
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from slipguard.lab.dataset_files import check_request, contact_sheet, read_backgrounds, render_dataset

    check_request(out, count, seed, split.value)
    real = read_backgrounds(backgrounds) if backgrounds is not None else None
    console = Console(stderr=True)
    columns = (TextColumn("rendering"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console) as bar:
        task = bar.add_task("frames", total=count)
        render_dataset(out, count, seed, split.value, real, lambda done: bar.update(task, completed=done))
    if show is not None:
        contact_sheet(out, show)
    print(f"{count} frames in {out}" + (f", a sheet in {show}" if show is not None else ""))
