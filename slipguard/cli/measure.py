"""`slipguard measure`: contact, angle and its uncertainty for frames in files."""

from __future__ import annotations

import json as jsonlib
import sys
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from slipguard.errors import InputError

if TYPE_CHECKING:
    from slipguard.tools.measure import FrameMeasurement

NO_BACKGROUND = (
    "no --background given: the untouched gel is guessed from each frame, so masks and angles are worse "
    "and a contact may be reported where there is none"
)
SHOWN_ROWS = 60


class ReferenceChoice(StrEnum):
    """Which frame turns are counted from."""

    stable = "stable"
    first = "first"


def measure(
    paths: Annotated[list[Path], typer.Argument(help="Images, a folder of images (by name), or a video.")],
    background: Annotated[
        Path | None, typer.Option(help="No-contact image of the same unit; without it results are worse.")
    ] = None,
    masks: Annotated[
        Path | None, typer.Option(help="Folder for the contact masks, named after the frames: PNG, 0 or 255.")
    ] = None,
    plot: Annotated[Path | None, typer.Option(help="Picture of turn, orientation and area over time.")] = None,
    json: Annotated[
        bool,
        typer.Option(
            "--json",
            help="Print one JSON object per frame and line; its key `declined` says why there is no angle, else null.",
        ),
    ] = False,
    independent: Annotated[
        bool, typer.Option("--independent", help="Every frame for itself instead of one recording.")
    ] = False,
    reference: Annotated[
        ReferenceChoice, typer.Option(help="Count turns from the first stable, or the first, contact frame.")
    ] = ReferenceChoice.stable,
    model: Annotated[Path | None, typer.Option(help="Another segmentation network (.onnx).")] = None,
    estimator: Annotated[str | None, typer.Option(help="How the angle is read from the contact.")] = None,
) -> None:
    """Measure contact, turn and uncertainty in gel images: 240x320 BGR pictures of a DIGIT.

    Example: `slipguard measure frames/ --background background.png --json --masks masks/`
    """
    from slipguard.perception.contact.segmenter import Segmenter
    from slipguard.perception.settings import PerceptionSettings
    from slipguard.tools import measure as lab
    from slipguard.tools.image_files import IMAGE_ENDINGS, find_image_files, read_gel_image

    files = find_image_files(paths)
    if masks is not None:
        _refuse_equal_stems([file for file in files if file.suffix.lower() in IMAGE_ENDINGS])
        _make_folder(masks)
    untouched = None if background is None else read_gel_image(background)
    choices: dict[str, str | Path] = {"reference": reference.value}
    if model is not None:
        choices["model"] = model
    if estimator is not None:
        choices["estimator"] = _known_estimator(estimator)
    settings = PerceptionSettings.model_validate(choices)
    segmenter = Segmenter(settings.model)
    if untouched is None:
        print(f"slipguard: {NO_BACKGROUND}", file=sys.stderr)
    done: list[FrameMeasurement] = []
    try:
        for measured in lab.measure(paths, segmenter, settings, untouched, independent):
            if json:
                print(jsonlib.dumps(lab.as_json(measured)), flush=True)
            if masks is not None:
                lab.write_mask(masks, measured)
            done.append(measured)
    finally:
        if not json and done:
            _show(done)
    if plot is not None:
        lab.plot(done, plot, untouched is not None)


def _refuse_equal_stems(files: list[Path]) -> None:
    seen: dict[str, Path] = {}
    for file in files:
        if file.stem in seen:
            raise InputError(f"{file} and {seen[file.stem]} would both write {file.stem}.png; measure them apart")
        seen[file.stem] = file


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: the folder for masks cannot be made ({error.strerror})") from error


def _known_estimator(name: str) -> str:
    import difflib
    from typing import get_args

    from slipguard.perception.settings import EstimatorName

    names = list(get_args(EstimatorName))
    if name not in names:
        near = difflib.get_close_matches(name, names, n=1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        raise InputError(f"--estimator {name}: there are {', '.join(names)}{hint}")
    return name


def _show(done: list[FrameMeasurement]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table("frame", "contact", "area px", "turn °", "orientation °", "method", "note")
    left_out = len(done) - SHOWN_ROWS
    for number, measured in enumerate(done):
        if left_out > 0 and SHOWN_ROWS // 2 <= number < len(done) - SHOWN_ROWS // 2:
            if number == SHOWN_ROWS // 2:
                table.add_row("…", "", "", "", "", "", f"{left_out} more; --json prints all")
            continue
        estimate = measured.estimate
        rotation = "" if estimate.angle_deg is None else f"{estimate.angle_deg:+.2f} ± {estimate.sigma_deg or 0.0:.2f}"
        axis = "" if estimate.orientation_deg is None else f"{estimate.orientation_deg:+.1f}"
        note = estimate.skipped or estimate.declined or ""
        contact = "yes" if estimate.contact else "no"
        area = str(estimate.contact_area_px)
        table.add_row(measured.still.name, contact, area, rotation, axis, estimate.method, note)
    console = Console()
    console.print(table)
    touching = [measured.estimate for measured in done if measured.estimate.contact]
    angles = [estimate.angle_deg for estimate in touching if estimate.angle_deg is not None]
    line = f"{len(done)} frames, contact in {len(touching)}, a turn told in {len(angles)}"
    if angles:
        line += f", from {min(angles):+.2f}° to {max(angles):+.2f}°, last {angles[-1]:+.2f}°"
    console.print(line)
