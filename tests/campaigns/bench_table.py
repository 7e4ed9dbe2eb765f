"""The table of networks and estimators in the model card."""

from __future__ import annotations

from pathlib import Path

from slipguard.bench.results import BenchReport
from slipguard.bench.tables import COLUMNS, cells_of, notes
from slipguard.errors import InputError

BEGIN, END = "<!-- bench table: begin -->", "<!-- bench table: end -->"


def markdown(found: BenchReport, command: str) -> str:
    """Return all rows as a Markdown table, with the command that produced it."""
    made = found.machine
    lines = [
        f"Made by `{command}` on {made['processor']}, onnxruntime {made['onnxruntime']}, OpenCV {made['opencv']};",
        "times in ms on one core unless stated, errors in degrees; ◆: on the Pareto front of mean time and error.",
        "",
        "| " + " | ".join(COLUMNS) + " |",
        "|" + "---|" * len(COLUMNS),
    ]
    lines += ["| " + " | ".join(cells_of(row, found)) + " |" for row in (*found.pipelines, *found.peers)]
    return "\n".join([*lines, "", *(f"* {note}" for note in notes(found))])


def split_at_markers(path: Path) -> tuple[str, str]:
    """Return the text before and after the markers of a Markdown file. Raises `InputError` if they are missing."""
    try:
        page = path.read_text(encoding="utf-8")
        before, rest = page.split(BEGIN)
        _, after = rest.split(END)
    except OSError as error:
        raise InputError(f"{path}: cannot read the file: {error.strerror}") from error
    except ValueError as error:
        raise InputError(f"{path}: needs the lines {BEGIN} and {END}, once each") from error
    return before, after


def write_into(path: Path, text: str) -> None:
    """Write the text between the markers of a Markdown file. Raises `InputError` if they are missing."""
    before, after = split_at_markers(path)
    path.write_text(f"{before}{BEGIN}\n\n{text}\n\n{END}{after}", encoding="utf-8")
