"""Plot of a campaign: final slip against force of every controller, one panel for each plant."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from slipguard.bench.grip import figures
from slipguard.bench.grip.campaign import BOUND, REACTIVE, GripCampaignResult
from slipguard.bench.grip.figures import ControllerRow
from slipguard.tools import plotting

COLORS = {
    "slipguard": "tab:blue", BOUND: "tab:green", REACTIVE: "tab:olive", "fixed step": "tab:orange",
    "no guard": "tab:gray", "rendered images": "navy", "the same, modeled": "skyblue",
}  # fmt: skip
CURVES = {"constant": "tab:purple", "naive": "tab:cyan"}
SMALLEST_DEG = 0.05
"""Smaller slips are drawn here, on a logarithmic axis."""
TICKS = (0.5, 0.7, 1.0, 1.3, 1.8, 2.5, 4.0)


def draw(campaigns: Sequence[GripCampaignResult], path: Path) -> None:
    """Write the plot."""
    figure = plotting.figure(6.5 * len(campaigns), 5.5)
    for axes, found in zip(figure.subplots(1, len(campaigns), squeeze=False)[0], campaigns, strict=True):
        if found.weak:
            _front(axes, figures.pareto_rows(found.weak))
        plan = found.plan
        axes.set_title(f"{len(found.weak)} weak first grips, plant {plan.plant}, {plan.seed_set} seed {plan.seed}")
    plotting.save(figure, path)


def _front(axes: Any, rows: Sequence[ControllerRow]) -> None:
    """Plot slip p95 to worst against force median to p95: a controller is good where nothing is below and left."""
    for kind, color in CURVES.items():
        curve = [row for row in rows if row.controller.startswith(kind)]
        force, slip = [row.force_over_needed_median for row in curve], [_shown(row.slip_p95_deg) for row in curve]
        axes.plot(force, slip, "o-", color=color, markersize=5, linewidth=1.0, label=kind)
        for row, x, y in zip(curve, force, slip, strict=True):
            axes.annotate(row.controller.split()[1], (x, y), xytext=(2, 4), textcoords="offset points", fontsize=7)
    for row in (row for row in rows if row.controller in COLORS):
        color, x, y = COLORS[row.controller], row.force_over_needed_median, _shown(row.slip_p95_deg)
        axes.plot([x, x], [y, _shown(row.slip_worst_deg)], color=color, linewidth=1.0, linestyle=":")
        axes.plot([x, row.force_over_needed_p95], [y, y], color=color, linewidth=1.0, linestyle=":")
        axes.plot(x, y, "o", color=color, markersize=9 if row.controller == "slipguard" else 6, label=row.controller)
    axes.set_xlabel("largest force over needed force: dot median, dotted line to p95")
    axes.set_ylabel("final slip in degrees: dot p95, dotted line to worst")
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xticks(TICKS, [f"{tick:g}" for tick in TICKS])
    axes.minorticks_off()
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)


def _shown(deg: float) -> float:
    return max(deg, SMALLEST_DEG)
