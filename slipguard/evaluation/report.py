"""Everything a report consists of, written into the experiment's folder."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from slipguard.errors import InputError
from slipguard.evaluation.html_report import write_page
from slipguard.evaluation.lift_data import lift_paths, read_lift
from slipguard.evaluation.networks import network_scores
from slipguard.evaluation.plots import draw_curves, draw_errors, draw_masks
from slipguard.evaluation.protocol import LiftProtocol
from slipguard.evaluation.runner import LIFTS, PROTOCOL, results
from slipguard.evaluation.summary import report_json
from slipguard.tools.parallel import Workers

PAGE, FIGURES = "report.html", "report.json"


def write_report(
    out: Path,
    workers: Workers,
    networks: Path | None = None,
    progress: Callable[[int], None] = lambda done: None,
    compared: Callable[[str], None] = lambda what: None,
) -> dict[str, Any]:
    """Write report.html, report.json and the PNGs; returns what report.json holds. Raises InputError."""
    lifts = results(out, workers, progress)
    rows = None if networks is None else _networks(out, networks, compared)
    report = report_json(lifts, rows)
    pictures = {"errors": out / "errors.png", "curves": out / "curves.png"}
    draw_errors(lifts, pictures["errors"])
    draw_curves(lifts, pictures["curves"])
    if draw_masks(out / LIFTS, lifts, out / "masks.png"):
        pictures["masks"] = out / "masks.png"
    try:
        write_page(out / PAGE, report, _protocol(out), pictures)
        (out / FIGURES).write_text(json.dumps(report, indent=1) + "\n")
    except OSError as error:
        raise InputError(f"{out}: the report cannot be written ({error.strerror})") from None
    return report


def _networks(out: Path, folder: Path, compared: Callable[[str], None]) -> list[dict[str, Any]]:
    rows = network_scores(folder)
    for path in lift_paths(out):
        compared(path.stem)
        data = read_lift(path)
        for row in rows:
            row.take(data)
    return [row.as_json() for row in rows]


def _protocol(out: Path) -> LiftProtocol | None:
    """What was asked for, where the folder still says so."""
    try:
        return LiftProtocol.model_validate(json.loads((out / PROTOCOL).read_text())["protocol"])
    except (OSError, ValueError, KeyError, TypeError):
        return None
