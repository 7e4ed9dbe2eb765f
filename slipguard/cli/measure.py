"""`slipguard measure`: contact, rotation and its uncertainty in image files."""

from __future__ import annotations

import json as jsonlib
import sys
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from slipguard.cli.terminal import make_folder
from slipguard.errors import InputError

if TYPE_CHECKING:
    from slipguard.tools.measure import Results

NO_BACKGROUND = (
    "no --background given: the rotation is that of the mask's axis ({estimator}), masks are less accurate, and "
    "contact may be reported where there is none"
)
FRAME_NAME_WIDTH = 28


class ReferenceChoice(StrEnum):
    """Frame that rotations refer to."""

    stable = "stable"
    first = "first"


def measure(
    paths: Annotated[list[Path], typer.Argument(help="Images, a folder of images (sorted by name), or a video.")],
    background: Annotated[
        Path | None,
        typer.Option(
            help="Background image (no contact) of the same sensor. Without it, rotation is that of the mask's axis."
        ),
    ] = None,
    masks: Annotated[
        Path | None, typer.Option(help="Folder for the contact masks, named like the frames: PNG, 0 or 255.")
    ] = None,
    plot: Annotated[Path | None, typer.Option(help="Plot rotation, orientation and area over time to a PNG.")] = None,
    json: Annotated[
        bool,
        typer.Option(
            "--json",
            help="Print one JSON object per frame and line: `declined` says why there is no angle, else null; "
            "`reference` names the frame that the angle counts from.",
        ),
    ] = False,
    independent: Annotated[
        bool, typer.Option("--independent", help="Treat each frame separately, not as one recording.")
    ] = False,
    reference: Annotated[
        ReferenceChoice,
        typer.Option(
            help="Reference of the rotation: the first stable (at most 0.1 s late), or the first, contact frame."
        ),
    ] = ReferenceChoice.stable,
    model: Annotated[Path | None, typer.Option(help="Segmentation network (.onnx). Default: the shipped one.")] = None,
    estimator: Annotated[
        str | None,
        typer.Option(
            help="Rotation estimator: registration, or the axis of the mask by moments, ellipse, pca or skeleton. "
            "Default: registration; without --background: moments."
        ),
    ] = None,
) -> None:
    """Measure contact, rotation and uncertainty in gel images: BGR, 240 wide x 320 high, of a DIGIT.

    Example: `slipguard measure frames/ --background background.png --json --masks masks/`
    """
    from slipguard.perception.segmenter import Segmenter
    from slipguard.perception.settings import PerceptionSettings
    from slipguard.tools import measure as tool
    from slipguard.tools.image_files import IMAGE_ENDINGS, find_image_files, read_gel_image
    from slipguard.tools.plotting import check_plot_path

    check_plot_path(plot)
    files = find_image_files(paths)
    if masks is not None:
        _check_mask_names([file for file in files if file.suffix.lower() in IMAGE_ENDINGS])
        make_folder(masks, "--masks")
    background_image = None if background is None else read_gel_image(background)
    choices: dict[str, str | Path] = {"reference": reference.value}
    if model is not None:
        choices["model"] = model
    if estimator is not None:
        choices["estimator"] = _check_estimator(estimator)
        if estimator == "registration" and background_image is None:
            raise InputError("--estimator registration: needs the sensor's background image; add --background")
    elif background_image is None:
        choices["estimator"] = "moments"
    settings = PerceptionSettings.model_validate(choices)
    segmenter = Segmenter(settings.model)
    if background_image is None:
        print(f"slipguard: {NO_BACKGROUND.format(estimator=settings.estimator)}", file=sys.stderr)
    done = tool.Results()
    try:
        for measured in tool.measure(paths, segmenter, settings, background_image, independent):
            if json:
                print(jsonlib.dumps(tool.as_json(measured)), flush=True)
            if masks is not None:
                tool.write_mask(masks, measured)
            done.add(measured.frame.name, measured.estimate)
    finally:
        if not json and done.count:
            _print_table(done)
    if plot is not None:
        tool.plot(done, plot, background_image is not None)


def _check_mask_names(files: list[Path]) -> None:
    names: dict[str, Path] = {}
    for file in files:
        if file.stem in names:
            raise InputError(f"{file} and {names[file.stem]} would both write {file.stem}.png; measure them separately")
        names[file.stem] = file


def _check_estimator(name: str) -> str:
    import difflib
    from typing import get_args

    from slipguard.perception.settings import EstimatorName

    names = list(get_args(EstimatorName))
    if name not in names:
        near = difflib.get_close_matches(name, names, n=1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        raise InputError(f"--estimator {name}: choose from {', '.join(names)}{hint}")
    return name


def _print_table(done: Results) -> None:
    import numpy as np
    from rich import box
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=(0, 1, 0, 0))
    table.add_column("frame", overflow="fold", max_width=FRAME_NAME_WIDTH)
    for name in ("area\npx", "rotation\n°", "orientation\n°"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("note", overflow="fold")
    rows = [*done.first, *done.last]
    for number, (name, estimate) in enumerate(rows):
        if number == len(done.first) and done.count > len(rows):
            table.add_row("…", "", "", "", f"{done.count - len(rows)} more; --json prints all")
        rotation = (
            "" if estimate.rotation_deg is None else f"{estimate.rotation_deg:+.2f} ± {estimate.sigma_deg or 0.0:.2f}"
        )
        axis = "" if estimate.orientation_deg is None else f"{estimate.orientation_deg:+.1f}"
        note = estimate.skipped or estimate.declined or ("" if estimate.contact else "no contact")
        area = str(estimate.contact_area_px) if estimate.contact else "–"
        table.add_row(Text(name), area, rotation, axis, Text(note))
    console = Console()
    console.print(table)
    rotations = done.column("rotation")
    rotations = rotations[np.isfinite(rotations)]
    method = rows[-1][1].method
    line = f"{done.count} frames, {done.in_contact} with contact, {len(rotations)} with a rotation (method {method})"
    if len(rotations):
        line += f", from {rotations.min():+.2f}° to {rotations.max():+.2f}°, last {rotations[-1]:+.2f}°"
    console.print(line)
