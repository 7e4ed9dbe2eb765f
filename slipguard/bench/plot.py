"""Plot of a bench: error against time, and time by stage."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from slipguard.bench.results import PUBLISHED, BenchReport, BenchRow
from slipguard.tools.plotting import figure, save

STAGES = ("gate", "segment", "regions", "relief", "angle", "thin", "register", "reference", "track")
MARKERS = {"registration": "o", "moments": "D", "ellipse": "^", "pca": "v", "skeleton": "P"}


def draw_bench(found: BenchReport, path: Path) -> None:
    """Draw the plot into an image file. Raises `InputError` if it cannot be written."""
    drawing = figure(13.0, 9.0)
    front, stages = drawing.subplots(2, 1, height_ratios=(1.8, 1.0))
    _front(front, found)
    _stages(stages, found)
    save(drawing, path)


def _front(axes: Any, found: BenchReport) -> None:
    """Plot the mean rotation error against the mean time of a frame while an object is held, with the Pareto front."""
    rows = [*found.pipelines, *found.peers]
    networks = list(dict.fromkeys(row.network for row in rows))
    colors = {network: f"C{index}" for index, network in enumerate(networks)}
    front, labelled = [], []
    for row in rows:
        if row.mean_ms_per_frame_grasp is None:
            continue
        x, y, color = row.mean_ms_per_frame_grasp, row.turn_error_mean_deg, colors[row.network]
        if y is None:
            axes.axvline(x, color=color, linestyle="--", linewidth=1)
            axes.annotate(
                f"{row.network}, {row.threads} thread{'s' * (row.threads > 1)}: time only", (x, 0.98),
                xycoords=("data", "axes fraction"), xytext=(-4, 0), textcoords="offset points", rotation=90,
                ha="right", va="top", fontsize=7, color=color,
            )  # fmt: skip
            continue
        chosen = row.name == found.default
        fill = color if row.skipping else "white"
        axes.plot(
            x, y, MARKERS.get(row.estimator, "o"), color=color, markerfacecolor=fill, markersize=11 if chosen else 7
        )
        if row.pareto:
            front.append((x, y))
        if row.pareto or row in found.peers:
            labelled.append((x, y, _short(row)))
    for index, (x, y, text) in enumerate(sorted(labelled, key=lambda one: one[1])):
        # Staggered, because names on the front are close together.
        axes.annotate(
            text, (x, y), xytext=(12, 14 + 13 * (index % 4)), textcoords="offset points", fontsize=8,
            arrowprops={"arrowstyle": "-", "color": "0.6", "linewidth": 0.6},
        )  # fmt: skip
    if front:
        axes.step(
            *zip(*sorted(front), strict=True), where="post", color="0.5", linewidth=1, zorder=0, label="Pareto front"
        )
    for name, marker in MARKERS.items():
        axes.plot([], [], marker, color="0.4", label=name)
    axes.plot([], [], "o", color="0.4", markerfacecolor="white", label="no skipping")
    for network, color in colors.items():
        axes.plot([], [], "s", color=color, label=network)
    published_deg = PUBLISHED["turn_error_mean_deg"]
    axes.axhline(published_deg, color="0.7", linestyle=":")
    axes.annotate(
        f"{published_deg:.2f}°: the paper's published error, on a real cell", (0.45, published_deg),
        xycoords=("axes fraction", "data"), xytext=(0, 3), textcoords="offset points", fontsize=8, color="0.4",
    )  # fmt: skip
    axes.set_xscale("log")
    axes.set_yscale("log")
    low, high = axes.get_ylim()
    axes.set_ylim(low / 1.3, high * 2.5)
    axes.set_xlabel("mean time of a frame while an object is held, ms (one core unless stated)")
    axes.set_ylabel("mean rotation error, degrees")
    axes.set_title("Rendered grasps of objects that are not in the training images")
    axes.grid(alpha=0.3, which="both")
    axes.legend(fontsize=7, loc="center left", bbox_to_anchor=(1.0, 0.5))


def _stages(axes: Any, found: BenchReport) -> None:
    """Plot the mean time of a frame in contact by stage, for each estimator with the default's network."""
    network = next(row.network for row in found.pipelines if row.name == found.default)
    rows = [row for row in found.pipelines if row.network == network and row.skipping]
    names = [row.estimator for row in rows]
    left = [0.0] * len(rows)
    for stage in STAGES:
        widths = [row.stage_ms.get(stage, (0.0, 0.0, 0.0))[2] for row in rows]
        if any(widths):
            label = "texture" if stage == "relief" else stage  # the key in the public JSON
            axes.barh(names, widths, left=left, label=label)
            left = [start + width for start, width in zip(left, widths, strict=True)]
    axes.invert_yaxis()
    axes.set_xlabel("mean time of a frame in contact, ms")
    axes.legend(fontsize=7, loc="center left", bbox_to_anchor=(1.0, 0.5))
    axes.set_title(f"Time by stage: {network}")


def _short(row: BenchRow) -> str:
    plain = row.name.replace("the paper's pipeline: ", "paper: ").replace(" + OpenCV thinning + line", "")
    return plain.replace("background subtraction", "subtraction").replace(", no skipping", "")
