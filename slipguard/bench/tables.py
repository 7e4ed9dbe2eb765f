"""Tables of a bench for the terminal."""

from __future__ import annotations

from rich.table import Table

from slipguard.bench.results import PUBLISHED, BenchReport, BenchRow, EffectResult
from slipguard.tools.figures import figure_table, text

PIPELINES = ("pipeline", "p50\nms", "p99\nms", "grasp\nms", "error\n°", "worst\n°", "declined", "Dice", "×\n240×320")
EFFECTS = (
    "effect", "n", "error\n°", "worst\n°", "decl.\n%", "within %\n1, 2 σ", "beyond %\n3, 4 σ", "p99\nσ", "zero\n°",
    "axis\n°",
)  # fmt: skip
SKIPS = ("skip", "frames\nskipped", "saves\nms", "over a grasp\nms per frame", "error added\n°")
SIZES = ("240×320", "120×160")
"""Input sizes of the paper's network: as published, and as trained for slipguard."""


def bench_tables(found: BenchReport) -> list[Table]:
    """Return the tables of pipelines, effects and skips; they fit into 80 columns."""
    rows = [pipeline_cells(row, found) for row in (*found.pipelines, *found.peers)]
    title = f"{found.machine['processor']}, one core unless stated; times in ms, errors in degrees"
    effects = [_effect_cells(one) for one in found.effects]
    skips = [
        [one.name, text(one.skipped, "{:,}"), text(one.saved_ms), text(one.saved_ms_per_frame_grasp),
         text(one.error_added_deg, "{:+.3f}")]
        for one in found.skips
    ]  # fmt: skip
    return [figure_table(PIPELINES, rows, title), figure_table(EFFECTS, effects), figure_table(SKIPS, skips)]


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


def pipeline_cells(row: BenchRow, found: BenchReport) -> list[str]:
    """Return the cells of a row in the order of PIPELINES."""
    return [
        f"[bold]{row.name} (default)[/]" if row.name == found.default else row.name,
        text(row.p50_ms),
        text(row.p99_ms),
        text(row.mean_ms_per_frame_grasp),
        text(row.turn_error_mean_deg),
        text(row.turn_error_worst_object_deg),
        text(row.declined_share, "{:.0%}"),
        text(row.dice, "{:.3f}"),
        text(_ratio(found.reference(SIZES[0]), row), "{:.1f}"),
    ]


def _ratio(peer: BenchRow | None, row: BenchRow) -> float | None:
    """Return the peer's time relative to the row's."""
    return None if peer is None or peer.p50_ms is None or not row.p50_ms else peer.p50_ms / row.p50_ms
