"""Tables of a bench for the terminal."""

from __future__ import annotations

from collections.abc import Iterable

from rich import box
from rich.table import Table

from slipguard.bench.results import PUBLISHED, BenchReport, BenchRow

COLUMNS = (
    "front", "pipeline", "p50", "p99", "skipped", "mean over a grasp", "CPU s per minute", "rotation error", "p95",
    "worst", "with an axis", "estimates", "declined", "round textured", "round plain declined", "within 1, 2 sigma",
    "Dice", "IoU", "× 240×320", "× 120×160",
)  # fmt: skip
SHOWN = {
    "": 0, "pipeline": 1, "p50\nms": 2, "p99\nms": 3, "grasp\nms": 5, "error\n°": 7, "worst\n°": 9, "declined": 12,
    "Dice": 16, "×\n240×320": 18,
}  # fmt: skip
"""Columns for the terminal, of 80 characters at least: title -> position in COLUMNS. --json has all figures."""
SIZES = ("240×320", "120×160")
"""Input sizes of the paper's network: as published, and as trained for slipguard."""


def bench_tables(found: BenchReport) -> list[Table]:
    """Return the tables of pipelines, effects, thinning and skips; they fit into 80 columns."""
    shown = _table(SHOWN, "pipeline")
    shown.title = f"{found.machine['processor']}, one core unless stated; times in ms, errors in degrees"
    for row in (*found.pipelines, *found.peers):
        cells = cells_of(row, found)
        cells[7] = cells[7].split(" ± ")[0]
        cells[1] = f"[bold]{cells[1]}[/]" if row.name == found.default else cells[1]
        shown.add_row(*(cells[at] for at in SHOWN.values()))
    thinned = _table(
        (
            "thinning",
            "masks",
            "ms",
            "cv2\n×",
            "scikit-image\nthin, ×",
            "scikit-image\nskeletonize, ×",
            "pixels unlike\ncv2",
        ),
        "thinning",
    )
    for one in found.thinning:
        ratios = [f"{one.ratios[key]:.1f}" for key in ("cv2", "scikit-image thin", "scikit-image skeletonize")]
        thinned.add_row(one.size, str(one.masks), f"{one.ms:.2f}", *ratios, str(one.pixels_different_from_cv2))
    skips = _table(
        ("skip", "used", "saves\nms", "over a grasp\nms per frame", "error added\n°", "frames\nlater"), "skip"
    )
    for skip in found.skips:
        skips.add_row(
            skip.name, "yes" if skip.kept else "no", _text(skip.saved_ms), _text(skip.saved_ms_per_frame_grasp),
            _text(skip.error_added_deg, "{:+.3f}"), _text(skip.frames_later, "{:+d}"),
        )  # fmt: skip
    return [shown, _effect_table(found), thinned, skips]


def _effect_table(found: BenchReport) -> Table:
    """Return the errors of the default pipeline by effect, and those of two baselines."""
    shown = _table(
        ("effect", "n", "error\n°", "worst\n°", "decl.\n%", "within %\n1, 2 σ", "beyond %\n3, 4 σ", "p99\nσ",
         "zero\n°", "axis\n°"), "effect",
    )  # fmt: skip
    for one in found.effects:
        within, beyond = (one.within_1_sigma, one.within_2_sigma), (one.beyond_3_sigma, one.beyond_4_sigma)
        shown.add_row(
            one.effect, str(one.n), _text(one.mean_deg), _text(one.worst_deg, "{:.1f}"),
            f"{100.0 * one.declined_share:.0f}",
            ", ".join(_text(None if share is None else 100.0 * share, "{:.0f}") for share in within),
            ", ".join(_text(None if share is None else 100.0 * share, "{:.1f}") for share in beyond),
            _text(one.error_over_sigma_p99, "{:.1f}"), _text(one.zero.mean_deg, "{:.1f}"),
            _text(one.paper_axis.mean_deg, "{:.1f}"),
        )  # fmt: skip
    return shown


def _table(columns: Iterable[str], text_column: str) -> Table:
    """Return a table with little space between its columns; only the text column is broken into lines."""
    made = Table(box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=(0, 1, 0, 0), title_justify="left")
    for name in columns:
        is_text = name == text_column
        made.add_column(name, justify="left" if is_text else "right", no_wrap=not is_text, overflow="fold")
    return made


def notes(found: BenchReport) -> list[str]:
    """Return notes that explain the figures."""
    published = [
        "published, on a real cell:",
        f"rotation error {PUBLISHED['turn_error_mean_deg']}° ± {PUBLISHED['turn_error_sd_deg']}°,",
        f"worst object {PUBLISHED['turn_error_worst_object_deg']:g}°,",
        f"Dice {PUBLISHED['dice']}, IoU {PUBLISHED['iou']}:",
        "another machine and other objects, not directly comparable",
    ]
    return [*found.notes, *_compared(found), " ".join(published)]


def skip_notes(found: BenchReport) -> list[str]:
    """Return on which frames each skip was measured."""
    return [f"{one.name}: measured on {one.how}" for one in found.skips]


def _compared(found: BenchReport) -> list[str]:
    """Return a note on the divisor of each of the last columns."""
    lines = []
    for size in SIZES:
        peer = found.reference(size)
        if peer is not None:
            threads = "one thread" if peer.threads == 1 else f"{peer.threads} threads"
            weights = "arbitrary weights, time only" if peer.turn_error_mean_deg is None else "trained weights"
            lines.append(
                f"× {size}: time (p50) of the paper's pipeline with {peer.network}, "
                f"{_text(peer.p50_ms)} ms on {threads}, its fastest number ({weights}), relative to the row's"
            )
    return lines


def cells_of(row: BenchRow, found: BenchReport) -> list[str]:
    """Return the cells of a row in the order of COLUMNS."""
    error, sd = _text(row.turn_error_mean_deg), _text(row.turn_error_sd_deg)
    return [
        "◆" if row.pareto else "",
        row.name + (" (default)" if row.name == found.default else ""),
        _text(row.p50_ms),
        _text(row.p99_ms),
        _text(row.skipped_p50_ms),
        _text(row.mean_ms_per_frame_grasp),
        _text(row.cpu_s_per_minute_grasp, "{:.1f}"),
        error if row.turn_error_mean_deg is None else f"{error} ± {sd}",
        _text(row.turn_error_p95_deg),
        _text(row.turn_error_worst_object_deg),
        _text(row.turn_error_readable_mean_deg),
        _text(row.turns, "{:,}"),
        _text(row.declined_share, "{:.0%}"),
        _text(row.round_textured_error_mean_deg),
        _text(row.round_plain_declined_share, "{:.0%}"),
        "–"
        if row.within_1_sigma is None
        else ", ".join(
            (_share(row.within_1_sigma, row.within_1_sigma_se), _share(row.within_2_sigma, row.within_2_sigma_se))
        ),
        _text(row.dice, "{:.3f}"),
        _text(row.iou, "{:.3f}"),
        *(_text(_ratio(found.reference(size), row), "{:.1f}") for size in SIZES),
    ]


def _ratio(peer: BenchRow | None, row: BenchRow) -> float | None:
    """Return the peer's time relative to the row's."""
    return None if peer is None or peer.p50_ms is None or not row.p50_ms else peer.p50_ms / row.p50_ms


def _text(value: float | None, form: str = "{:.2f}") -> str:
    return "–" if value is None else form.format(value)


def _share(value: float | None, se: float | None) -> str:
    """Return a share in percent, with its standard error if known."""
    return _text(value, "{:.0%}") if value is None or se is None else f"{100 * value:.0f} ± {100 * se:.0f}%"
