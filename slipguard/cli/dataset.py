"""`slipguard dataset`: images with masks, rendered or somebody's own, and a picture to look at them."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from slipguard.cli.progress import count_bar
from slipguard.cli.record import record

app = typer.Typer(no_args_is_help=True, rich_markup_mode="markdown")


class Split(StrEnum):
    """Which objects are pressed."""

    train = "train"
    test = "test"


@app.callback()
def dataset() -> None:
    """Images with masks, rendered or your own: to train on, to look at.

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
    jobs: Annotated[int, typer.Option(min=0, help="Processes; 0: one for each core.")] = 0,
    cluster: Annotated[
        str | None, typer.Option(help="Render on a Dask cluster instead: its scheduler, tcp://HOST:8786.")
    ] = None,
) -> None:
    """Render frames with their no-contact images and masks, and a manifest.

    Example: `slipguard dataset render --out frames --count 200 --split test --show sheet.png`
    """
    from slipguard.datasets.contact_sheet import contact_sheet
    from slipguard.datasets.files import check_request, read_backgrounds, render_dataset
    from slipguard.tools.parallel import Workers

    check_request(out, count, seed, split.value)
    workers = Workers(jobs, cluster)
    real = read_backgrounds(backgrounds) if backgrounds is not None else None
    with count_bar("rendering", count) as show_count:
        render_dataset(out, count, seed, split.value, real, show_count, workers)
    if show is not None:
        contact_sheet(out, show)
    print(f"{count} frames in {out}" + (f", a sheet in {show}" if show is not None else ""))


@app.command(name="import")
def import_(
    source: Annotated[Path, typer.Argument(help="Folder of images and masks.")],
    out: Annotated[Path, typer.Option(help="Folder to write to: new or empty.")],
    background: Annotated[
        Path | None, typer.Option(help="The sensor's no-contact image, 240 wide x 320 high, if there is one.")
    ] = None,
    skip: Annotated[bool, typer.Option("--skip", help="Leave out what has no partner or cannot be read.")] = False,
    show: Annotated[Path | None, typer.Option(help="Write a sheet of some frames to this PNG.")] = None,
    jobs: Annotated[int, typer.Option(min=0, help="Processes; 0: one for each core.")] = 0,
    cluster: Annotated[
        str | None, typer.Option(help="A Dask cluster that sees the same files: its scheduler, tcp://HOST:8786.")
    ] = None,
) -> None:
    """Turn a folder of images and masks into a data set to train on.

    Two layouts are known, also below train/ or val/: images/ and masks/ with the same names, or NAME.png beside
    NAME_mask.png. Masks are 0 and 1, or 0 and 255. Pictures become 240 wide x 320 high.

    Example: `slipguard dataset import recordings --out frames --show sheet.png`
    """
    from slipguard.datasets.contact_sheet import contact_sheet
    from slipguard.datasets.files import check_new, read_background
    from slipguard.datasets.importer import found_pairs, import_dataset
    from slipguard.tools.parallel import Workers

    no_contact = read_background(background) if background is not None else None
    check_new(out)
    found_pairs(source)
    with count_bar("importing") as show_count:
        done = import_dataset(source, out, no_contact, skip, show_count, Workers(jobs, cluster))
    if show is not None:
        contact_sheet(out, show)
    notes = [f"{done.frames} frames in {out}"]
    notes += [f"{done.rotated} turned upright"] if done.rotated else []
    notes += [f"{done.stretched} stretched to 3:4"] if done.stretched else []
    notes += [f"{len(done.left_out)} left out, the first: {done.left_out[0]}"] if done.left_out else []
    print("; ".join(notes) + (f"; a sheet in {show}" if show is not None else ""))


@app.command()
def show(
    folder: Annotated[Path, typer.Argument(help="A data set: rendered, imported or recorded.")],
    out: Annotated[Path, typer.Option(help="The PNG to write.")],
) -> None:
    """Draw a sheet of a data set's frames: each image, and below it with its label laid over it.

    Example: `slipguard dataset show frames --out sheet.png`
    """
    from slipguard.datasets.contact_sheet import contact_sheet

    contact_sheet(folder, out)
    print(f"a sheet in {out}")


app.command()(record)
