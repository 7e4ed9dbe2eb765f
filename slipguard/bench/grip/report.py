"""Tables of a campaign."""

from __future__ import annotations

from collections.abc import Sequence

from rich import box
from rich.console import Console
from rich.table import Table

from slipguard.bench.grip import figures
from slipguard.bench.grip.added_mass import added_mass_figures
from slipguard.bench.grip.campaign import BOUND, REACTING, REACTIVE, GripCampaignResult
from slipguard.bench.grip.json_figures import as_json, checks

ADDED_HEADS = ("", "n", "bound holds", "held", "slide p95", "of bound", "answer p95", "over bound")
ADDED_KEYS = (
    "scenarios", "bound_holds", "held", "slide_p95_mm", "bound_slide_p95_mm", "answer_s_p95", "answer_over_bound_s_p95",
)  # fmt: skip
HEADS = ("", "n", "slip", "p95", "max", "slide", "max", "drops", "force", "p95")


def print_tables(console: Console, found: GripCampaignResult) -> None:
    """Print slip against force of every controller, slipguard and the bound by group, firm grasps and limits."""
    weak = found.weak
    rows = figures.pareto_rows(weak)
    title = f"{len(weak)} lifts with a first grip that is too weak: {_plan(found)}"
    console.print(_table(title, HEADS, [_cells(row.controller, row) for row in rows]))
    avoidable = figures.pareto_rows(found.avoidable)
    excess = figures.excess_over_bound((one for one in found.results if one.scenario.weak), REACTIVE)
    title = f"{len(found.avoidable)} of all {len(excess)} weak first grips that camera, wire and jaws can answer"
    console.print(_table(title, HEADS, [_cells(row.controller, row) for row in avoidable]))
    lines = []
    for name, part in figures.groups(found).items():
        for controller in ("slipguard", BOUND):
            row = figures.ControllerRow.of(controller, [one.outcomes[controller] for one in part])
            lines.append(_cells(name if controller == "slipguard" else "  bound", row))
    console.print(_table("slipguard and the clairvoyant bound by group", HEADS, lines))
    beyond = figures.excess_over_bound(found.beyond_actuator)
    if beyond:
        deg, mm = (sorted(values)[len(beyond) // 2] for values in zip(*beyond, strict=True))
        console.print(
            f"{len(beyond)} more lifts whose load arrives faster than the gripper tightens: slipguard's slip over the "
            f"bound's {deg:.1f}° and {mm:.1f} mm (median)"
        )
    firm = figures.firm_rows(found.firm, REACTING)
    heads = ("", "n", "lifts tightened", "held", "force/grip")
    cells = [
        (one.controller, str(one.count), str(one.lifting), str(one.held), f"{one.force_median:.2f}") for one in firm
    ]
    hold = f"{found.plan.hold_s:g} s of taps, shaking and arm motions"
    title = f"false tightenings of firm grasps: during the lift, then while held through {hold}"
    console.print(_table(title, heads, cells))
    rows_added = [
        (kind, *("–" if one[key] is None else f"{one[key]:g}" for key in ADDED_KEYS))
        for kind, one in added_mass_figures(found.added_mass).items()
    ]
    console.print(_table("0.6 kg added on the grip axis: mm, and seconds from the first slip", ADDED_HEADS, rows_added))
    found_json = as_json(found)
    limits = [
        (one.limit.title, f"≤ {one.limit.at_most:g}", "–" if one.value is None else f"{one.value:.3g}",
         "yes" if one.kept else "NO")
        for one in checks(found_json)
    ]  # fmt: skip
    console.print(_table("limits", ("", "limit", "slipguard", "kept"), limits))
    better = figures.dominated_by(rows)
    console.print("better in slip and force: " + (", ".join(better) if better else "no baseline"))
    console.print(
        "slip: true rotation at the end without elastic torsion, in degrees, median; slide: translation in mm, p95; a "
        "dropped object counts as 60° and 12 mm; force: largest true over needed force, median; constant: share of the "
        "force limit; clairvoyant: commands the needed force when the load begins to arrive; reactive: 1.3 times "
        "that when the cameras have seen the object move",
        style="dim",
    )


def _plan(found: GripCampaignResult) -> str:
    return f"plant {found.plan.plant}, {found.plan.seed_set} seed {found.plan.seed}"


def _cells(name: str, row: figures.ControllerRow) -> tuple[str, ...]:
    slips = (row.slip_median_deg, row.slip_p95_deg, row.slip_worst_deg, row.slide_p95_mm, row.slide_worst_mm)
    forces = (f"{row.force_median:.2f}", f"{row.force_p95:.2f}")
    return (name, str(row.count), *(f"{one:.1f}" for one in slips), str(row.drops), *forces)


def _table(title: str, heads: Sequence[str], lines: Sequence[Sequence[str]]) -> Table:
    table = Table(
        title=title, box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False, title_justify="left", padding=(0, 1, 0, 0)
    )
    for k, name in enumerate(heads):
        table.add_column(name, justify="right" if k else "left", no_wrap=True)
    for line in lines:
        table.add_row(*line)
    return table
