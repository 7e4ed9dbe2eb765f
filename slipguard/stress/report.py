"""Table and plot of a stress run."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rich.console import Console

from slipguard.stress.perturbations import PERTURBATIONS
from slipguard.stress.run import KINDS, PerturbationFigures, StressRun
from slipguard.tools import plotting
from slipguard.tools.figures import Figures, figure_table, text

PLOT = "error-against-noise.png"
SHOWN_FAILURES = 10
STRENGTH = "strength"
HEADS = ("perturbation", "tried", "esti-\nmated", "crash", "NaN", "wrong", "limit", "worst\n°", "worst\nσ")


def print_table(console: Console, found: StressRun) -> None:
    """Print one row for each perturbation, where the sweeps break, and the failures."""
    console.print(
        figure_table(HEADS, [_cells(one) for one in found.perturbations.values()], f"Stress, seed {found.seed}")
    )
    console.print(
        "estimated: share not declined; wrong: confident beyond 4 sigma; limit: drift, invalid sigma, or too few "
        "estimates; worst: largest error, and largest error over its sigma",
        style="dim",
    )
    console.print(f"{found.tried:,} trials in {found.spent_s:.0f} s: {100.0 * found.share:.3g} % of the full list")
    for name, level in found.broken_at.items():
        console.print(f"{name}: an estimate is off by more than 4 sigma from size {level:g} on", highlight=False)
    for failure in found.first_failures[:SHOWN_FAILURES]:
        console.print(f"[red]{failure.kind}[/] in {failure.name}: {failure.what}", highlight=False)
        console.print(f"    reproduce: {failure.command}", highlight=False)
    if len(found.first_failures) > SHOWN_FAILURES:
        console.print(f"… and {len(found.first_failures) - SHOWN_FAILURES} more; --out lists them")


def _cells(one: PerturbationFigures) -> list[str]:
    possible = one.estimated + one.declined
    counts = [one.count(kind) for kind in KINDS]
    return [
        one.name,
        str(len(one.trials)),
        f"{100.0 * one.estimated / possible:.0f}%" if possible else "–",
        *(f"[red]{count:,}[/]" if count else "0" for count in counts),
        text(one.worst_deg, "{:.1f}"),
        text(one.worst_sigmas, "{:.1f}"),
    ]


def draw(found: StressRun, path: Path) -> None:
    """Plot errors against the levels of each perturbation. Raises InputError if the file cannot be written."""
    ran = {name: one for name, one in found.perturbations.items() if PERTURBATIONS[name].unit}
    panels = [[name] for name in ran if PERTURBATIONS[name].unit != STRENGTH]
    distortions = [name for name in ran if PERTURBATIONS[name].unit == STRENGTH]
    panels += [distortions] if distortions else []
    figure = plotting.figure(18.0, 9.0)
    grid = figure.subplots(2, -(-max(len(panels), 2) // 2), squeeze=False)
    for axes in grid.flat[len(panels) :]:
        axes.set_visible(False)
    for axes, names in zip(grid.flat, panels, strict=False):
        for name in names:
            _curve(axes, ran[name])
        axes.set_yscale("symlog", linthresh=0.1)
        axes.set_ylim(0.0, 100.0)
        axes.set_xlabel(PERTURBATIONS[names[0]].unit)
        axes.set_ylabel("rotation error, degrees")
        axes.grid(alpha=0.3)
        axes.legend(loc="upper left", fontsize=7)
    figure.suptitle(f"Rotation error: mean (solid) and 95th percentile (dashed); {found.tried:,} trials")
    plotting.save(figure, path)


def _curve(axes: Any, one: PerturbationFigures) -> None:
    by_level: dict[float, list[float]] = {}
    for _, outcome in one.trials:
        by_level.setdefault(outcome.level, []).extend(error for error, _ in outcome.errors)
    figures = {level: Figures.of(errors) for level, errors in sorted(by_level.items()) if errors}
    [line] = axes.plot(list(figures), [each.mean for each in figures.values()], "-o", markersize=3, label=one.name)
    axes.plot(list(figures), [each.p95 for each in figures.values()], "--", color=line.get_color(), linewidth=0.8)
