"""What a run found: a table for people, one JSON object for programs, a picture of errors against noise."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from slipguard.stress.drift_families import DRIFT, HOLDING
from slipguard.stress.runner import StressOutcome, full_hours
from slipguard.stress.shape_families import ASPECT
from slipguard.stress.trial_family import CurvePoint, FailureKind, FamilyResults, TrialFailure, TrialFamily
from slipguard.tools import plotting as figures

SHOWN_FAILURES = 10


SUMMARY = ("tried", "share", "crashes", "nan", "confident_wrong", "worst", "drift_deg")
"""What `--json` prints of `as_json`; `stress.json` in the --out folder holds all of it."""


def summary(outcome: StressOutcome) -> dict[str, Any]:
    """The one object that `--json` prints: the keys of `SUMMARY`."""
    whole = as_json(outcome)
    return {key: whole[key] for key in SUMMARY}


def as_json(outcome: StressOutcome) -> dict[str, Any]:
    """All that was found. Errors in degrees; share: of the full list's work, by reckoned time.

    worst: largest error of any answer, by family, however large its sigma. A figure that was not tried is null.
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
        "drift_deg": _promise(outcome, DRIFT),
        "holding_drift_deg": _promise(outcome, HOLDING),
        "aspect_1_2_error_deg": _promise(outcome, ASPECT),
        "seed": outcome.seed,
        "spent_s": round(outcome.spent_s, 2),
        "full_hours": _rounded(total_h),
        "families": {family.name: _family(family, results) for family, results in _pairs(outcome)},
        "failures": [
            {"family": one.family, "kind": one.kind, "seed": one.seed, "what": one.what, "again": again(one)}
            for one in first_failures(outcome)
        ],
    }


def first_failures(outcome: StressOutcome) -> list[TrialFailure]:
    """The first failure of each kind in each family, and the families that answered too little."""
    firsts = [*outcome.rarely_answering]
    for results in outcome.results:
        seen: set[FailureKind] = set()
        for one in results.failures:
            if one.kind not in seen:
                seen.add(one.kind)
                firsts.append(one)
    return firsts


def again(failure: TrialFailure) -> str:
    """The command that shows it again, as its first trial or on the way."""
    return f"slipguard stress --only {failure.family} --seed {failure.seed}"


def print_table(console: Console, outcome: StressOutcome) -> None:
    """The same for people."""
    table = Table(title=f"Stress, seed {outcome.seed}", title_justify="left", box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for name in ("family", "tried", "of list", "told", "crash", "NaN", "wrong", "broken", "worst", "sigmas"):
        table.add_column(name, justify="left" if name == "family" else "right", no_wrap=True)
    for family, results in _pairs(outcome):
        silent = sum(one.family == family.name for one in outcome.rarely_answering)
        broken = results.counts["limit"] + silent
        counts = [*(_coloured(results.counts[kind]) for kind in ("crash", "nan", "confident wrong")), _coloured(broken)]
        worst, sigmas = max(results.worst_deg.values(), default=None), max(results.worst_sigmas.values(), default=None)
        asked = results.answers + results.declined
        table.add_row(
            family.name,
            str(results.tried),
            f"{100.0 * results.tried / (family.full * family.frames):.3g}%",
            f"{100.0 * results.answers / asked:.0f}%" if asked else "",
            *counts,
            "" if worst is None else f"{worst:.1f}°",
            "" if sigmas is None else f"{sigmas:.1f}",
        )
    console.print(table)
    console.print(
        "told: of what was asked; wrong: by more than 5 sigma and 3°; broken: the promises below, or too little told; "
        "worst, sigmas: the largest error and the largest of errors in sigma, of any two trials",
        style="dim",
    )
    promises = {what: value for results in outcome.results for what, value in results.promises.items()}
    for what, value in promises.items():
        console.print(f"{what}: at most {value:.3g}")
    hours = full_hours(outcome.families)
    share = 100.0 * _done_hours(outcome) / hours
    console.print(
        f"{sum(results.tried for results in outcome.results):,} trials in {outcome.spent_s:.0f} s: {share:.3g} % of the full "
        f"list, which takes about {hours:.2g} h of one core (--seconds 0)"
    )
    firsts = first_failures(outcome)
    for one in firsts[:SHOWN_FAILURES]:
        console.print(f"[red]{one.kind}[/] in {one.family}: {one.what}", highlight=False)
        console.print(f"    again: {again(one)}", highlight=False)
    if len(firsts) > SHOWN_FAILURES:
        console.print(f"… and {len(firsts) - SHOWN_FAILURES} more; --out lists them")


def draw(outcome: StressOutcome, path: Path) -> None:
    """Error against noise into a picture file. Raises InputError when it cannot be written."""
    curves = {name: levels for results in outcome.results for name, levels in results.curves.items()}
    panels = (
        ("outline", "outline off by (network pixels, 1 sd)"),
        ("grey", "white noise on the probability (1 sd)"),
        ("frame noise", "noise of the camera (grey levels, 1 sd), through the network"),
        ("relief noise", "noise of the camera (grey levels, 1 sd), relief alone"),
        ("aspect, outline 0 px", "aspect of a near-circle, clean outline"),
        ("aspect, outline 0.2 px", "aspect of a near-circle, outline off by 0.2 px"),
        ("aspect, outline 0.4 px", "aspect of a near-circle, outline off by 0.4 px"),
    )
    drawing = figures.figure(18.0, 9.0)
    grid = drawing.subplots(2, 4)
    colours = {"moments": "C0", "ellipse": "C1", "pca": "C2", "skeleton": "C3", "fused": "C4", "pipeline": "black"}
    for axes, (sweep, label) in zip(grid.flat, panels, strict=False):
        min_answered_share = axes.twinx()
        for reader, colour in colours.items():
            levels = curves.get(f"{sweep}/{reader}", {})
            places = sorted(levels)
            if not places:
                continue
            wide = 2.2 if reader == "pipeline" else 1.2
            min_answered_share.plot(places, [_declined(levels[at]) for at in places], ":", color=colour, linewidth=0.8)
            answered = [at for at in places if levels[at].errors_deg]
            axes.plot(answered, [np.mean(levels[at].errors_deg) for at in answered], "-o", color=colour, markersize=3,
                      linewidth=wide, label=reader)  # fmt: skip
            axes.plot(answered, [np.percentile(levels[at].errors_deg, 95) for at in answered], "--", color=colour,
                      linewidth=0.8)  # fmt: skip
        axes.set_yscale("symlog", linthresh=0.1)
        axes.set_ylim(0.0, 100.0)
        axes.set_xlabel(label)
        axes.set_ylabel("error of the turn, degrees")
        min_answered_share.set_ylim(0.0, 105.0)
        min_answered_share.set_ylabel("no answer, % (dotted)")
        axes.grid(alpha=0.3)
        if axes.get_legend_handles_labels()[0]:
            axes.legend(loc="upper left", fontsize=8)
    for unused in grid.flat[len(panels) :]:
        unused.set_visible(False)
    count = sum(len(level.errors_deg) for levels in curves.values() for level in levels.values())
    drawing.suptitle(
        f"Error against noise: mean (lines), 95th percentile (dashed); {count:,} answers, seed {outcome.seed}"
    )
    figures.save(drawing, path)


def _family(family: TrialFamily, results: FamilyResults) -> dict[str, Any]:
    return {
        "tried": results.tried,
        "full": family.full * family.frames,
        "least_told": family.min_answered_share,
        "answers": results.answers,
        "declined": results.declined,
        "failures": {kind: count for kind, count in results.counts.items() if count},
        "worst_deg": {label: _rounded(value) for label, value in results.worst_deg.items()},
        "worst_sigmas": {label: _rounded(value) for label, value in results.worst_sigmas.items()},
        "promises": {what: _rounded(value) for what, value in results.promises.items()},
    }


def _pairs(outcome: StressOutcome) -> list[tuple[TrialFamily, FamilyResults]]:
    return list(zip(outcome.families, outcome.results, strict=True))


def _done_hours(outcome: StressOutcome) -> float:
    return sum(family.cost_ms * results.tried / family.frames for family, results in _pairs(outcome)) / 3.6e6


def _count(outcome: StressOutcome, kind: FailureKind) -> int:
    return sum(results.counts[kind] for results in outcome.results)


def _promise(outcome: StressOutcome, what: str) -> float | None:
    found = [results.promises[what] for results in outcome.results if what in results.promises]
    return _rounded(max(found)) if found else None


def _declined(level: CurvePoint) -> float:
    return 100.0 * level.declined / max(level.declined + len(level.errors_deg), 1)


def _coloured(count: int) -> str:
    return f"[red]{count:,}[/]" if count else "0"


def _rounded(value: float) -> float:
    return float(f"{value:.4g}")
