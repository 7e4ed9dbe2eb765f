"""`slipguard turned`: turns of known size on real pixels."""

from __future__ import annotations

import json as jsonlib
from dataclasses import asdict, fields
from pathlib import Path
from typing import Annotated

import typer


def turned(
    folder: Annotated[Path, typer.Argument(help="Folder with taxim_sphere/ and anytouch2_force2/.")],
    part: Annotated[str, typer.Option(help="Presses to turn: tune, test or all.")] = "test",
    model: Annotated[Path | None, typer.Option(help="Another network (.onnx) in place of the shipped one.")] = None,
    json: Annotated[bool, typer.Option("--json", help="One JSON object a data set and way of turning.")] = False,
) -> None:
    """Turn real presses by known angles, relit and rigid, and measure how well the pipeline tells them.

    Semi-synthetic: the pixels are a real sensor's, the turn is made. In `rigid` the lights turn along, which flatters.

    Example: `slipguard turned real_digit/ --part test --json`
    """
    from rich.console import Console
    from rich.progress import Progress
    from rich.table import Table

    from slipguard.lab import turned_report
    from slipguard.lab.turned_presses import WAYS
    from slipguard.perception.segment import Segmenter

    segmenter, progress = Segmenter(model), Console(stderr=True)
    rows: list[turned_report.Figures] = []
    with Progress(console=progress, transient=True, disable=not progress.is_terminal) as bar:
        for way in WAYS:
            task = bar.add_task(way, total=1.0)
            found = turned_report.measure(
                folder,
                part,
                way,
                segmenter,
                lambda name, share, task=task, way=way: bar.update(  # type: ignore[misc]
                    task, description=f"{way} {name}", completed=share
                ),
            )
            rows += turned_report.figures(found, way)
    if json:
        for row in rows:
            print(jsonlib.dumps(asdict(row)))
        return
    table = Table(title=f"Semi-synthetic turns, part {part}", title_justify="left")
    for field in fields(turned_report.Figures):
        table.add_column(field.name.replace("_", " "))
    for row in rows:
        table.add_row(*("" if value is None else str(value) for value in asdict(row).values()))
    Console().print(table)
