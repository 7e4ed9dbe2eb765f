"""Tables of a campaign, both plants beside each other."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from rich import box
from rich.console import Console
from rich.table import Table

from slipguard.bench.grip import figures
from slipguard.bench.grip.campaign import REACTING, GripCampaignResult
from slipguard.bench.grip.json_figures import LimitCheck, as_json, checks

HEADS = ("slip", "drop", "force")
NOTES = (
    "slip: true rotation at the end without elastic torsion, in degrees: median/p95/worst; a dropped object counts as "
    "60°; force: largest true over needed force: median/p95; constant: share of the force limit; naive: 10 N for each "
    "so many degrees; clairvoyant: commands the needed force when the load begins to arrive; reactive: 1.3 times that "
    "when the cameras have seen the object move"
)


def print_tables(console: Console, campaigns: Sequence[GripCampaignResult]) -> None:
    """Print slip against force of every controller, slipguard by group, firm grasps, disturbances and limits."""
    found = [as_json(one) for one in campaigns]
    console.print(_side_by_side("first grip too weak", campaigns, HEADS, _controller_rows))
    console.print(_side_by_side("slipguard by group", campaigns, HEADS, _group_rows))
    console.print(_side_by_side("firm grasps", campaigns, ("n", "tighter", "force p95"), _firm_rows))
    heads = ("n", "drop", "slip p95", "tighter", "force")
    console.print(_side_by_side("held objects, disturbed one way after the other", campaigns, heads, _disturbed_rows))
    limits = [checks(one) for one in found]
    table = _table("limits", ("", "limit", *(one.plan.plant for one in campaigns)))
    for of_plants in zip(*limits, strict=True):
        limit = of_plants[0].limit
        table.add_row(limit.title, f"≤ {limit.at_most:g}", *(_value(one) for one in of_plants))
    console.print(table)
    for one in found:
        beyond, better, naive = one["beyond_actuator"], one["dominated_by"], one["naive_at_equal_force"]
        equal = f"; naive at force {naive['force_over_needed_median']:.2f}: slip p95 {naive['naive_slip_p95_deg']:.1f}°"
        console.print(
            f"{one['plant']}: better in slip and force: {', '.join(better) or 'no baseline'}{equal if naive else ''}; "
            f"{beyond['scenarios']} more lifts whose load arrives faster than the gripper tightens"
        )
    console.print(NOTES, style="dim")


def _value(check: LimitCheck) -> str:
    if check.value is None:
        return "–"
    return f"{check.value:.3g}" + ("" if check.kept else " NO")


def _controller_rows(found: GripCampaignResult) -> dict[str, tuple[str, ...]]:
    return {row.controller: _cells(row) for row in figures.pareto_rows(found.weak)}


def _group_rows(found: GripCampaignResult) -> dict[str, tuple[str, ...]]:
    return {
        name: _cells(figures.ControllerRow.of("slipguard", [one.slipguard for one in part]))
        for name, part in figures.groups(found).items()
    }


def _firm_rows(found: GripCampaignResult) -> dict[str, tuple[str, ...]]:
    rows = figures.firm_rows(found.firm, REACTING)
    return {row.controller: (str(row.count), str(row.tightened), f"{row.force_p95:.2f}") for row in rows}


def _disturbed_rows(found: GripCampaignResult) -> dict[str, tuple[str, ...]]:
    return {
        name: (
            str(one["count"]), str(one["drops_beyond_bound"]), f"{one['slip_p95_deg']:.1f}", str(one["tightened"]),
            f"{one['force_ratio_worst']:.2f}",
        )
        for name, one in figures.disturbances(found.results).items()
    }  # fmt: skip


def _cells(row: figures.ControllerRow) -> tuple[str, ...]:
    slips = (row.slip_median_deg, row.slip_p95_deg, row.slip_worst_deg)
    slip = "/".join(f"{one:.1f}" if one < 10.0 else f"{one:.0f}" for one in slips)
    force = f"{row.force_over_needed_median:.2f}/{row.force_over_needed_p95:.2f}"
    return slip, f"{row.drops}/{row.scenarios}", force


def _side_by_side(
    title: str,
    campaigns: Sequence[GripCampaignResult],
    heads: Sequence[str],
    rows_of: Callable[[GripCampaignResult], dict[str, tuple[str, ...]]],
) -> Table:
    """Return one table in which each plant has these columns."""
    plan = campaigns[0].plan
    plants = " | ".join(one.plan.plant for one in campaigns)
    table = _table(f"{title}: {plants}, {plan.seed_set} seed {plan.seed}", ("", *(list(heads) * len(campaigns))))
    parts = [rows_of(one) for one in campaigns]
    for name in dict.fromkeys(name for part in parts for name in part):
        table.add_row(name, *(cell for part in parts for cell in part.get(name, ("–",) * len(heads))))
    return table


def _table(title: str, heads: Sequence[str]) -> Table:
    table = Table(
        title=title, box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False, title_justify="left", padding=(0, 1, 0, 0)
    )
    for k, name in enumerate(heads):
        table.add_column(name, justify="right" if k else "left", no_wrap=True)
    return table
