"""Tables of a bench for the terminal."""

from __future__ import annotations

from rich.table import Table

from slipguard.bench.results import PUBLISHED, BenchReport, BenchRow, EffectResult
from slipguard.tools.figures import figure_table, text

COLUMNS = (
    "front", "pipeline", "p50", "p99", "skipped", "mean over a grasp", "CPU s per minute", "rotation error", "p95",
    "worst", "with an axis", "estimates", "declined", "round textured", "round plain declined", "within 1, 2 sigma",
    "Dice", "IoU", "× 240×320", "× 120×160",
)  # fmt: skip
SHOWN = {
    "pipeline": 1, "p50\nms": 2, "p99\nms": 3, "grasp\nms": 5, "error\n°": 7, "worst\n°": 9, "declined": 12,
    "Dice": 16, "×\n240×320": 18,
}  # fmt: skip
"""Columns for the terminal, of 80 characters at least: title -> position in COLUMNS. --json has all figures."""
EFFECTS = (
    "effect", "n", "error\n°", "worst\n°", "decl.\n%", "within %\n1, 2 σ", "beyond %\n3, 4 σ", "p99\nσ", "zero\n°",
    "axis\n°",
)  # fmt: skip
SKIPS = ("skip", "frames\nskipped", "saves\nms", "over a grasp\nms per frame", "error added\n°")
SIZES = ("240×320", "120×160")
"""Input sizes of the paper's network: as published, and as trained for slipguard."""


def bench_tables(found: BenchReport) -> list[Table]:
    """Return the tables of pipelines, effects and skips; they fit into 80 columns."""
    rows = []
    for row in (*found.pipelines, *found.peers):
        cells = cells_of(row, found)
        cells[7] = cells[7].split(" ± ")[0]
        cells[1] = f"[bold]{cells[1]}[/]" if row.name == found.default else cells[1]
        rows.append([cells[at] for at in SHOWN.values()])
    title = f"{found.machine['processor']}, one core unless stated; times in ms, errors in degrees"
    effects = [_effect_cells(one) for one in found.effects]
    skips = [
        [one.name, text(one.skipped, "{:,}"), text(one.saved_ms), text(one.saved_ms_per_frame_grasp),
         text(one.error_added_deg, "{:+.3f}")]
        for one in found.skips
    ]  # fmt: skip
    return [figure_table(list(SHOWN), rows, title), figure_table(EFFECTS, effects), figure_table(SKIPS, skips)]


def _effect_cells(one: EffectResult) -> list[str]:
    """Return the errors of the default pipeline, and those of two baselines."""
    within, beyond = (one.within_1_sigma, one.within_2_sigma), (one.beyond_3_sigma, one.beyond_4_sigma)
    return [
        one.effect,
        str(one.n),
        text(one.mean_deg),
        text(one.worst_deg, "{:.1f}"),
        f"{100.0 * one.declined_share:.0f}",
        ", ".join(text(None if share is None else 100.0 * share, "{:.0f}") for share in within),
        ", ".join(text(None if share is None else 100.0 * share, "{:.1f}") for share in beyond),
        text(one.error_over_sigma_p99, "{:.1f}"),
        text(one.zero.mean_deg, "{:.1f}"),
        text(one.paper_axis.mean_deg, "{:.1f}"),
    ]


def notes(found: BenchReport) -> list[str]:
    """Return notes that explain the figures."""
    published = [
        "published, on a real cell:",
        f"rotation error {PUBLISHED['turn_error_mean_deg']}° ± {PUBLISHED['turn_error_sd_deg']}°,",
        f"worst object {PUBLISHED['turn_error_worst_object_deg']:g}°,",
        f"Dice {PUBLISHED['dice']}, IoU {PUBLISHED['iou']}:",
        "another machine and other objects, not directly comparable",
    ]
    ratio = found.thinning_vs_cv2
    thinning = [] if ratio is None else [f"thinning of masks of 240×320 is {ratio:.1f} times as fast as OpenCV's"]
    return [*found.notes, *thinning, *_compared(found), " ".join(published)]


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
                f"{text(peer.p50_ms)} ms on {threads}, its faster number ({weights}), relative to the row's"
            )
    return lines


def cells_of(row: BenchRow, found: BenchReport) -> list[str]:
    """Return the cells of a row in the order of COLUMNS."""
    error, sd = text(row.turn_error_mean_deg), text(row.turn_error_sd_deg)
    return [
        "◆" if row.pareto else "",
        row.name + (" (default)" if row.name == found.default else ""),
        text(row.p50_ms),
        text(row.p99_ms),
        text(row.skipped_p50_ms),
        text(row.mean_ms_per_frame_grasp),
        text(row.cpu_s_per_minute_grasp, "{:.1f}"),
        error if row.turn_error_mean_deg is None else f"{error} ± {sd}",
        text(row.turn_error_p95_deg),
        text(row.turn_error_worst_object_deg),
        text(row.turn_error_readable_mean_deg),
        text(row.turns, "{:,}"),
        text(row.declined_share, "{:.0%}"),
        text(row.round_textured_error_mean_deg),
        text(row.round_plain_declined_share, "{:.0%}"),
        "–"
        if row.within_1_sigma is None
        else ", ".join(
            (_share(row.within_1_sigma, row.within_1_sigma_se), _share(row.within_2_sigma, row.within_2_sigma_se))
        ),
        text(row.dice, "{:.3f}"),
        text(row.iou, "{:.3f}"),
        *(text(_ratio(found.reference(size), row), "{:.1f}") for size in SIZES),
    ]


def _ratio(peer: BenchRow | None, row: BenchRow) -> float | None:
    """Return the peer's time relative to the row's."""
    return None if peer is None or peer.p50_ms is None or not row.p50_ms else peer.p50_ms / row.p50_ms


def _share(value: float | None, se: float | None) -> str:
    """Return a share in percent, with its standard error if known."""
    return text(value, "{:.0%}") if value is None or se is None else f"{100 * value:.0f} ± {100 * se:.0f}%"
