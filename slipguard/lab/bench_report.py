"""The result of a bench for people: a table, and a picture of error against time."""

from __future__ import annotations

from pathlib import Path

from rich.table import Table

from slipguard.lab.bench import Bench, Row
from slipguard.lab.figures import figure, save

COLUMNS = ("p50 ms", "p99 ms", "no contact", "turn error", "worst object", "declined", "Dice", "IoU", "× peer")


def table(found: Bench) -> Table:
    """One line a pipeline and peer; the last column says how many times faster than the peer it is."""
    shown = Table("pipeline", *COLUMNS, title=f"{found.machine['processor']}, one core; times in ms, errors in degrees")
    reference_ms = found.peers[0].p50_ms
    for row in (*found.pipelines, *found.peers):
        name = row.estimator if row in found.pipelines else row.name
        if row.name == found.default:
            name = f"[bold]{name}[/] (default)"
        shown.add_row(name, *_figures(row), f"{reference_ms / row.p50_ms:.0f}")
    return shown


def notes(found: Bench) -> list[str]:
    """What the figures are, in a few lines."""
    first = found.pipelines[0]
    return [
        f"{first.frames} frames of {first.sequences} rendered grasps of the test objects; times of frames in contact",
        "the peer has the paper's network in shape, with made-up weights, and OpenCV's thinning: its time is real,",
        "its accuracy is not known here (the paper states 1.85° on its own recordings)",
    ]


def picture(found: Bench, path: Path) -> None:
    """Mean turn error against time a frame, the peer as a line. Raises `InputError` where it cannot be written."""
    drawing = figure(8.0, 5.0)
    axes = drawing.add_subplot()
    for row, marker in zip(found.pipelines, "osD^vP", strict=False):
        if row.turn_error_mean_deg is None:
            continue
        chosen = row.name == found.default
        (line,) = axes.plot([row.p50_ms, row.p99_ms], [row.turn_error_mean_deg] * 2, "-", alpha=0.4)
        name = f"{row.estimator} (default)" if chosen else row.estimator
        size = 10 if chosen else 6
        axes.plot(row.p50_ms, row.turn_error_mean_deg, marker, color=line.get_color(), markersize=size, label=name)
    axes.legend(loc="lower right", title="estimator")
    for row in found.peers:
        axes.axvline(row.p50_ms, color="0.4", linestyle="--")
        axes.annotate(
            f"{row.name}\n(time only)", (row.p50_ms, 0.97), xycoords=("data", "axes fraction"), xytext=(-6, 0),
            textcoords="offset points", ha="right", va="top", fontsize=8,
        )  # fmt: skip
    axes.set_xscale("log")
    axes.set_ylim(bottom=0.0)
    axes.margins(y=0.1)
    axes.set_xlabel("time for a frame in contact, ms (dot: median, line: to the 99th percentile)")
    axes.set_ylabel("mean turn error, degrees")
    axes.set_title("Rendered grasps of the test objects, one core")
    axes.grid(alpha=0.3)
    save(drawing, path)


def _figures(row: Row) -> list[str]:
    return [
        f"{row.p50_ms:.2f}",
        f"{row.p99_ms:.2f}",
        _text(row.skipped_p50_ms, "{:.2f}"),
        _text(row.turn_error_mean_deg, "{:.2f}"),
        _text(row.turn_error_worst_object_deg, "{:.2f}"),
        _text(row.declined_share, "{:.0%}"),
        _text(row.dice, "{:.3f}"),
        _text(row.iou, "{:.3f}"),
    ]


def _text(value: float | None, form: str) -> str:
    return "–" if value is None else form.format(value)
