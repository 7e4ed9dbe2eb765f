"""Plot of a campaign: the Pareto front of final slip and force, and force against need of every lift."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from slipguard.bench.grip import figures
from slipguard.bench.grip.campaign import BOUND, REACTIVE, GripCampaignResult
from slipguard.bench.grip.figures import ControllerRow
from slipguard.tools import plotting

COLORS = {
    "slipguard": "tab:blue",
    BOUND: "tab:green",
    REACTIVE: "tab:olive",
    "naive steps": "tab:cyan",
    "proportional steps": "tab:red",
    "fixed step": "tab:orange",
    "no guard": "tab:gray",
}
CONSTANT = "tab:purple"
SMALLEST_DEG = 0.05
"""Smaller slips are drawn here, on a logarithmic axis."""


def draw(found: GripCampaignResult, path: Path) -> None:
    """Write the plot."""
    figure = plotting.figure(13.0, 5.5)
    left, right = figure.subplots(1, 2)
    rows = figures.pareto_rows(found.weak)
    if rows:
        _front(left, rows)
        _forces(right, found)
    figure.suptitle(
        f"{len(found.weak)} weak first grips, plant {found.plan.plant}, {found.plan.seed_set} seed {found.plan.seed}"
    )
    plotting.save(figure, path)


def _front(axes: Any, rows: list[ControllerRow]) -> None:
    """Plot slip p95 to worst against force median to p95: a controller is good where nothing is below and left."""
    constants = [row for row in rows if row.controller.startswith("constant")]
    axes.plot(
        [row.force_median for row in constants],
        [max(row.slip_p95_deg, SMALLEST_DEG) for row in constants],
        color=CONSTANT, linewidth=1.0, alpha=0.6,
    )  # fmt: skip
    labelled: set[str] = set()
    for row in rows:
        name = "constant" if row in constants else row.controller
        color = CONSTANT if name == "constant" else COLORS[name]
        p95, worst = (max(value, SMALLEST_DEG) for value in (row.slip_p95_deg, row.slip_worst_deg))
        if name != "constant":
            axes.plot([row.force_median] * 2, [p95, worst], color=color, linewidth=1.0, linestyle=":")
            axes.plot([row.force_median, row.force_p95], [p95] * 2, color=color, linewidth=1.0, linestyle=":")
        label = None if name in labelled else name
        labelled.add(name)
        size = 9 if name == "slipguard" else 6
        axes.plot(row.force_median, p95, "o", color=color, markersize=size, label=label)
        if name == "constant":
            share = row.controller.removeprefix("constant ")
            at = {"xytext": (2, 4), "textcoords": "offset points", "rotation": 45.0}
            axes.annotate(share, (row.force_median, p95), fontsize=7, **at)
    axes.set_xlabel("largest force over needed force: dot median, dotted line to p95")
    axes.set_ylabel("final slip in degrees: dot p95, dotted line to worst")
    axes.set_yscale("log")
    axes.set_xscale("log")
    ticks = (0.5, 0.7, 1.0, 1.3, 1.8, 2.5, 4.0)
    axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.minorticks_off()
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)


def _forces(axes: Any, found: GripCampaignResult) -> None:
    """Plot the force over the needed one against the need of each weak lift; a cross is a dropped object."""
    for name in ("slipguard", "proportional steps", BOUND):
        for dropped, marker in ((False, "."), (True, "x")):
            shown = [one for one in found.weak if (one.outcomes[name].dropped is not None) is dropped]
            shares = [
                one.scenario.needed_n / (one.scenario.pose.gripper.gain * one.scenario.force_max_n) for one in shown
            ]
            over = [one.outcomes[name].force_over_needed for one in shown]
            axes.plot(shares, over, marker, color=COLORS[name], label=None if dropped else name)
    axes.axhline(1.0, color="black", linewidth=0.8)
    axes.set_xscale("log")
    ticks = (0.1, 0.2, 0.4, 0.6, 0.95)
    axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.minorticks_off()
    axes.set_xlabel("needed force over force limit")
    axes.set_ylabel("largest force over needed force (cross: dropped)")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
