"""Report of a stress run: a table, a JSON object, and a plot of errors against noise."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from slipguard.stress.axis_families import ASPECT
from slipguard.stress.drift_families import DRIFT, HOLDING
from slipguard.stress.runner import StressOutcome, full_hours
from slipguard.stress.trial_family import FailureKind, FamilyResults, TrialFailure, TrialFamily
from slipguard.tools import plotting

PLOT = "error-against-noise.png"
SHOWN_FAILURES = 10
SUMMARY = ("tried", "share", "crashes", "nan", "confident_wrong", "worst", "drift_deg", "broken_at")
"""Keys of `as_json` that `--json` prints; `stress.json` in the --out folder contains all of them."""
PANELS = (
    ("outline", "contour error in network pixels (1 sd)"),
    ("frame noise", "camera noise in gray levels (1 sd), with the network"),
    ("relief noise", "camera noise in gray levels (1 sd), texture only"),
    ("relief fall", "acceleration of a toothed object in degrees/s2"),
    ("aspect, outline 0 px", "aspect ratio, no contour error"),
    ("aspect, outline 0.2 px", "aspect ratio, contour error 0.2 px"),
    ("aspect, outline 0.4 px", "aspect ratio, contour error 0.4 px"),
)
COLORS = {"moments": "C0", "ellipse": "C1", "pca": "C2", "skeleton": "C3", "pipeline": "black"}


def summary(outcome: StressOutcome) -> dict[str, Any]:
    """Return the object that `--json` prints: the keys of `SUMMARY`."""
    whole = as_json(outcome)
    return {key: whole[key] for key in SUMMARY}


def as_json(outcome: StressOutcome) -> dict[str, Any]:
    """Return all results; errors in degrees, values that were not measured are null.

    share: of the full list, by estimated time. worst: the largest error in each family, regardless of its sigma.
    broken_at: the smallest size of each swept effect at which an estimate was off by more than 4 sigma.
    """
    total_h = full_hours(outcome.families)
    return {
        "tried": sum(results.tried for results in outcome.results),
        "share": _rounded(_done_hours(outcome) / total_h),
        "crashes": _count(outcome, "crash"),
        "nan": _count(outcome, "nan"),
        "confident_wrong": _count(outcome, "confident wrong"),
        "broken_promises": _count(outcome, "limit") + len(outcome.rarely_answering),
        "worst": {
            results.family: _rounded(max(results.worst_deg.values(), default=0.0)) for results in outcome.results
        },
        "drift_deg": _largest(outcome, DRIFT),
        "holding_drift_deg": _largest(outcome, HOLDING),
        "aspect_1_2_error_deg": _largest(outcome, ASPECT),
        "broken_at": {effect: _rounded(level) for effect, level in _broken(outcome)},
        "seed": outcome.seed,
        "spent_s": round(outcome.spent_s, 2),
        "full_hours": _rounded(total_h),
        "families": {family.name: _family_as_json(family, results) for family, results in _pairs(outcome)},
        "failures": [
            {"family": one.family, "kind": one.kind, "seed": one.seed, "what": one.what, "again": command_for(one)}
            for one in first_failures(outcome)
        ],
    }


def _family_as_json(family: TrialFamily, results: FamilyResults) -> dict[str, Any]:
    return {
        "tried": results.tried,
        "full": family.full * family.frames,
        "least_told": family.min_answered_share,
        "answers": results.estimated,
        "declined": results.declined,
        "failures": {kind: count for kind, count in results.counts.items() if count},
        "worst_deg": {label: _rounded(value) for label, value in results.worst_deg.items()},
        "worst_sigmas": {label: _rounded(value) for label, value in results.worst_sigmas.items()},
        "promises": {what: _rounded(value) for what, value in results.largest.items()},
        "broken_at": {effect: _rounded(level) for effect, level in sorted(results.broken_at.items())},
    }


def first_failures(outcome: StressOutcome) -> list[TrialFailure]:
    """Return the first failure of each kind in each family, and the families with too many declined estimates."""
    firsts = [*outcome.rarely_answering]
    for results in outcome.results:
        firsts += {one.kind: one for one in reversed(results.failures)}.values()
    return firsts


def command_for(failure: TrialFailure) -> str:
    """Return the command that reproduces a failure."""
    return f"slipguard stress --only {failure.family} --seed {failure.seed}"


def print_table(console: Console, outcome: StressOutcome) -> None:
    """Print one row for each family, the largest values with a specified limit, and the failures."""
    table = Table(title=f"Stress, seed {outcome.seed}", title_justify="left", box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for name in ("family", "tried", "of list", "estimated", "crash", "NaN", "wrong", "limits", "worst", "sigmas"):
        table.add_column(name, justify="left" if name == "family" else "right", no_wrap=True)
    for family, results in _pairs(outcome):
        limits = results.counts["limit"] + sum(one.family == family.name for one in outcome.rarely_answering)
        counts = [results.counts[kind] for kind in ("crash", "nan", "confident wrong")]
        worst, sigmas = max(results.worst_deg.values(), default=None), max(results.worst_sigmas.values(), default=None)
        possible = results.estimated + results.declined
        table.add_row(
            family.name,
            str(results.tried),
            f"{100.0 * results.tried / (family.full * family.frames):.3g}%",
            f"{100.0 * results.estimated / possible:.0f}%" if possible else "",
            *(_colored(count) for count in (*counts, limits)),
            "" if worst is None else f"{worst:.1f}°",
            "" if sigmas is None else f"{sigmas:.1f}",
        )
    console.print(table)
    console.print(
        "estimated: share not declined; wrong: pipeline above 4 sigma; limits: values above a limit below, or too "
        "few estimates; worst, sigmas: largest error, and largest error in units of its sigma",
        style="dim",
    )
    for results in outcome.results:
        for what, value in results.largest.items():
            console.print(f"{what}: at most {value:.3g}")
    hours = full_hours(outcome.families)
    console.print(
        f"{sum(results.tried for results in outcome.results):,} trials in {outcome.spent_s:.0f} s: "
        f"{100.0 * _done_hours(outcome) / hours:.3g} % of the full list, which takes about {hours:.2g} h on one core "
        "(the campaign stress-list)"
    )
    for effect, level in _broken(outcome):
        console.print(f"{effect}: an estimate is off by more than 4 sigma from size {level:g} on", highlight=False)
    firsts = first_failures(outcome)
    for one in firsts[:SHOWN_FAILURES]:
        console.print(f"[red]{one.kind}[/] in {one.family}: {one.what}", highlight=False)
        console.print(f"    reproduce: {command_for(one)}", highlight=False)
    if len(firsts) > SHOWN_FAILURES:
        console.print(f"… and {len(firsts) - SHOWN_FAILURES} more; --out lists them")


def draw(outcome: StressOutcome, path: Path) -> None:
    """Plot errors against noise into an image file. Raises InputError if it cannot be written."""
    curves = {name: levels for results in outcome.results for name, levels in results.curves.items()}
    figure = plotting.figure(18.0, 9.0)
    grid = figure.subplots(2, 4)
    for axes, (sweep, label) in zip(grid.flat, PANELS, strict=False):
        declined_axes = axes.twinx()
        for estimator, color in COLORS.items():
            points = sorted(curves.get(f"{sweep}/{estimator}", {}).items())
            if not points:
                continue
            shares = [100.0 * p.declined / max(p.declined + len(p.errors_deg), 1) for _, p in points]
            declined_axes.plot([level for level, _ in points], shares, ":", color=color, linewidth=0.8)
            known = [(level, point.errors_deg) for level, point in points if point.errors_deg]
            levels = [level for level, _ in known]
            width = 2.2 if estimator == "pipeline" else 1.2
            axes.plot(levels, [np.mean(errors) for _, errors in known], "-o", color=color, markersize=3,
                      linewidth=width, label=estimator)  # fmt: skip
            axes.plot(levels, [np.percentile(errors, 95) for _, errors in known], "--", color=color, linewidth=0.8)
        axes.set_yscale("symlog", linthresh=0.1)
        axes.set_ylim(0.0, 100.0)
        axes.set_xlabel(label)
        axes.set_ylabel("rotation error, degrees")
        declined_axes.set_ylim(0.0, 105.0)
        declined_axes.set_ylabel("declined, % (dotted)")
        axes.grid(alpha=0.3)
        if axes.get_legend_handles_labels()[0]:
            axes.legend(loc="upper left", fontsize=8)
    for unused in grid.flat[len(PANELS) :]:
        unused.set_visible(False)
    count = sum(len(point.errors_deg) for levels in curves.values() for point in levels.values())
    figure.suptitle(
        f"Error against noise: mean (solid), 95th percentile (dashed); {count:,} estimates, seed {outcome.seed}"
    )
    plotting.save(figure, path)


def _pairs(outcome: StressOutcome) -> list[tuple[TrialFamily, FamilyResults]]:
    return list(zip(outcome.families, outcome.results, strict=True))


def _done_hours(outcome: StressOutcome) -> float:
    return sum(family.cost_ms * results.tried / family.frames for family, results in _pairs(outcome)) / 3.6e6


def _broken(outcome: StressOutcome) -> list[tuple[str, float]]:
    return sorted(item for results in outcome.results for item in results.broken_at.items())


def _count(outcome: StressOutcome, kind: FailureKind) -> int:
    return sum(results.counts[kind] for results in outcome.results)


def _largest(outcome: StressOutcome, what: str) -> float | None:
    found = [results.largest[what] for results in outcome.results if what in results.largest]
    return _rounded(max(found)) if found else None


def _colored(count: int) -> str:
    return f"[red]{count:,}[/]" if count else "0"


def _rounded(value: float) -> float:
    return float(f"{value:.4g}")
