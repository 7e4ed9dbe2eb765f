"""`slipguard turned`: turns of known size on real pixels."""

from __future__ import annotations

import json as jsonlib
from dataclasses import asdict, fields
from pathlib import Path
from typing import Annotated

import typer

from slipguard.cli.progress import progress_bar


def rotated(
    folder: Annotated[Path, typer.Argument(help="Folder with taxim_sphere/ and anytouch2_force2/.")],
    part: Annotated[str, typer.Option(help="Presses to turn: tune, test or all.")] = "test",
    model: Annotated[Path | None, typer.Option(help="Another network (.onnx) in place of the shipped one.")] = None,
    json: Annotated[bool, typer.Option("--json", help="One JSON object a data set and way of turning.")] = False,
) -> None:
    """Turn real presses by known angles, relit and rigid, and measure how well the pipeline tells them.

    Semi-synthetic: the pixels are a real sensor's, the turn is made. In `rigid` the lights turn along, which flatters.

    Example: `slipguard rotated real_digit/ --part test --json`
    """
    from rich.console import Console
    from rich.table import Table

    from slipguard.evaluation import rotated_presses as rotated_report
    from slipguard.evaluation.rotated_presses import ROTATION_METHODS
    from slipguard.perception.contact.segmenter import Segmenter

    segmenter = Segmenter(model)
    rows: list[rotated_report.PressStatistics] = []
    for way in ROTATION_METHODS:
        with progress_bar(way) as show:
            rows += rotated_report.press_statistics(
                rotated_report.measure_presses(folder, part, way, segmenter, show), way
            )
    if json:
        for row in rows:
            print(jsonlib.dumps(asdict(row)))
        return
    table = Table(title=f"Semi-synthetic turns, part {part}", title_justify="left")
    for field in fields(rotated_report.PressStatistics):
        table.add_column(field.name.replace("_", " "))
    for row in rows:
        table.add_row(*("" if value is None else str(value) for value in asdict(row).values()))
    Console().print(table)
