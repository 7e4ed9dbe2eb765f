"""Tables, plot and JSON lines of a campaign."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from slipguard.devices import FINGERS
from slipguard.sim_lifts.lift_record import (
    IMAGE_SIGN,
    EstimatedRotation,
    LiftRecord,
    latency_figures,
    rotation_errors,
    summary,
)
from slipguard.tools import plotting as figures
from slipguard.tools.figures import Figures, figure_table, rounded, text

SOURCES = (*FINGERS, "fused")
HEADS = (
    "object", "true\nrot.", "meas.\nrot.", "error", "sigma", "grip/\nneed N", "", "p50/p99\nms", "skipped", "late",
)  # fmt: skip
WIDE = 90
"""Terminal width from which table columns have a gap."""
LEGEND = (
    "largest rotation until the end of the lift, true and measured; mean error and median sigma of the estimates, in "
    "degrees; largest grip force / largest needed force, N per finger; latency of the loop p50 / p99; frames skipped, "
    "by reason; late: missed deadlines"
)


def record_line(record: LiftRecord, *, realtime: bool) -> dict[str, object]:
    sigmas = [one.sigma_deg for one in record.fused]
    rotations_deg: list[float] = [one.rotation_deg for one in record.fused if one.captured_at_s <= record.ended_at_s]
    peak_deg: float = max(rotations_deg, key=abs, default=0.0)
    return {
        "object": record.object_name,
        "outcome": record.outcome,
        "why": record.why or None,
        "true_turn_deg": round(record.true_rotation_deg, 2),
        "true_slip_deg": round(record.true_slip_deg, 2),
        "measured_turn_deg": round(peak_deg, 2) if rotations_deg else None,
        "turn_error_deg": rounded(Figures.of(np.abs(record.errors_deg(record.fused))).mean, 3),
        "sigma_deg": round(float(np.median(sigmas)), 3) if sigmas else None,
        "peak_force_n": round(max((now.force_n for now in record.truth), default=0.0), 1),
        "needed_force_n": round(max((now.needed_force_n for now in record.truth), default=0.0), 1),
        **latency_figures(record.latency_s, realtime=realtime),
        "frames": record.frames,
        "skipped": dict(record.skips),
        "deadlines_missed": record.deadlines_missed,
    }


def print_lines(records: list[LiftRecord], *, realtime: bool) -> None:
    """Print one JSON object per lift, then the errors of each source, then the summary as the last line."""
    for record in records:
        print(json.dumps({"lift": record_line(record, realtime=realtime)}))
    for source in SOURCES:
        print(json.dumps({"turn_errors": asdict(rotation_errors(records, source))}))
    print(json.dumps({"summary": summary(records, realtime=realtime)}), flush=True)


def print_tables(console: Console, records: list[LiftRecord], *, realtime: bool) -> None:
    """Print tables that fit into 80 columns."""
    console.print(_lift_table(records, realtime=realtime, gap=1 if console.width >= WIDE else 0))
    hard = {f"{record.object_name} ({record.hard})" for record in records if record.hard}
    if hard:
        console.print(f"hard cases: {', '.join(sorted(hard))}")
    for record in records:
        if record.why:
            console.print(f"{record.object_name} {record.outcome}: {record.why}")
    console.print(LEGEND, style="dim")
    console.print("\nrotation errors (estimated minus true) of all frames of the lifts with a rotation of at least 10°")
    console.print(_error_table(records))
    figures_now = summary(records, realtime=realtime)
    console.print(
        f"{figures_now['lifts']} lifts: {figures_now['held']} held, {figures_now['dropped']} dropped, "
        f"{figures_now['refused']} refused; rotated over 20° or dropped: {figures_now['over_20_deg_or_dropped']}"
    )
    if records:
        console.print(
            f"true rotation of the objects: median {figures_now['true_turn_median_deg']}°, "
            f"largest {figures_now['true_turn_max_deg']}°; of it slip: median {figures_now['true_slip_median_deg']}°, "
            f"largest {figures_now['true_slip_max_deg']}° (the rest is elastic torsion of the gels)"
        )
    if figures_now["latency_p99_ms"] is not None:
        console.print(
            f"latency, frame received → command issued or not needed: "
            f"p50 {figures_now['latency_p50_ms']} ms, p99 {figures_now['latency_p99_ms']} ms"
        )


def _lift_table(records: list[LiftRecord], *, realtime: bool, gap: int) -> Table:
    """Return a table with one row per lift; without `gap` it fits into 80 columns."""
    rows = []
    for record in records:
        line = record_line(record, realtime=realtime)
        color = {"held": "green", "dropped": "red"}.get(record.outcome, "yellow")
        share = {name: count / max(record.frames, 1) for name, count in record.skips.items()}
        latency = latency_figures(record.latency_s, realtime=realtime)
        p50_ms, p99_ms = latency["latency_p50_ms"], latency["latency_p99_ms"]
        rows.append(
            (
                record.object_name,
                _number(line["true_turn_deg"], "{:+.1f}"),
                _number(line["measured_turn_deg"], "{:+.1f}"),
                _number(line["turn_error_deg"]),
                _number(line["sigma_deg"]),
                f"{line['peak_force_n']:.0f}/{line['needed_force_n']:.0f}",
                f"[{color}]{record.outcome}[/]",
                "–" if p50_ms is None or p99_ms is None else f"{p50_ms:.1f}/{p99_ms:.1f}",
                "\n".join(f"{100 * value:.0f}% {name}" for name, value in share.items()) or "–",
                str(record.deadlines_missed),
            )
        )
    return figure_table(HEADS, rows, gap=gap)


def _error_table(records: list[LiftRecord]) -> Table:
    rows = []
    for source in SOURCES:
        one = rotation_errors(records, source)
        worst = "–" if one.worst_object_deg is None else f"{one.worst_object_deg:.2f}° ({one.worst_object})"
        rows.append((source, str(one.lifts), text(one.mean_deg, "{:.2f}°"), text(one.p95_deg, "{:.2f}°"), worst))
    return figure_table(("source", "lifts", "mean", "p95", "worst object"), rows)


def _number(value: object, form: str = "{:.2f}") -> str:
    return "–" if value is None else form.format(value)


def draw(records: list[LiftRecord], path: Path) -> None:
    """Plot each lift: true and estimated rotation above, force and needed force below."""
    columns = 3
    rows = -(-len(records) // columns)
    drawing = figures.figure(5.2 * columns, 3.6 * rows)
    outer = drawing.subfigures(rows, columns, squeeze=False)
    for index, place in enumerate(outer.flat):
        if index >= len(records):
            continue
        record = records[index]
        upper, lower = place.subplots(2, 1, sharex=True, height_ratios=(2, 1))
        start_s = record.truth[0].time_s if record.truth else 0.0
        truth_s = [now.time_s - start_s for now in record.truth]
        rotations_deg = [now.rotation_deg - record.truth[0].rotation_deg for now in record.truth]
        slips_deg = [now.slip_deg - record.truth[0].slip_deg for now in record.truth]
        upper.plot(truth_s, rotations_deg, color="black", lw=2.2, label="true")
        upper.plot(truth_s, slips_deg, color="black", lw=1.0, ls="--", label="true slip")
        for finger, color in zip(FINGERS, ("tab:blue", "tab:orange"), strict=True):
            label = finger if IMAGE_SIGN[finger] > 0 else f"{finger} (sign inverted)"
            upper.plot(*_points(record.measured(finger), start_s), ".", ms=2.5, color=color, label=label)
        upper.plot(*_points(record.fused, start_s), color="tab:red", lw=1.0, label="fused")
        upper.set_ylabel("rotation / °")
        upper.set_title(f"{record.object_name}: {record.outcome}, slip {record.true_slip_deg:+.1f}°", fontsize=10)
        lower.plot(truth_s, [now.force_n for now in record.truth], color="tab:green", label="grip, per finger")
        lower.plot(truth_s, [now.needed_force_n for now in record.truth], color="tab:gray", ls="--", label="needed")
        lower.set_ylabel("force / N")
        lower.set_xlabel("time / s")
        lower.set_ylim(bottom=0)
        for axes in (upper, lower):
            axes.grid(alpha=0.3)
            if index == 0:
                axes.legend(fontsize=7, loc="best")
    figures.save(drawing, path)


def _points(estimated: list[EstimatedRotation], start_s: float) -> tuple[list[float], list[float]]:
    return [one.captured_at_s - start_s for one in estimated], [one.rotation_deg for one in estimated]
