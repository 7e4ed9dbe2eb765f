"""Tables and plot of a campaign."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table

from slipguard.bench.grip.campaign import GripCampaignResult, TrialOutcomes
from slipguard.bench.grip.campaign_figures import GROUPS, agreement, as_json, checks, failures, remarks
from slipguard.bench.grip.group_statistics import (
    FLOOR_DEG,
    GELS,
    SHOWN,
    GripRow,
    by_first_grip,
    by_gel,
    of,
    of_gel,
    row,
)
from slipguard.bench.grip.trial_run import HIGH_MM, ControllerName, TrialOutcome, run_trial
from slipguard.bench.grip.trials import FRAGILE_MAX_N, SHARES, TIGHT_SHARES
from slipguard.tools import plotting

COLORS: dict[ControllerName, str] = {
    "slipguard": "tab:blue",
    "oracle": "tab:green",
    "fixed step": "tab:orange",
    "unguarded": "tab:gray",
}
NAMES = {who: "no guard" if who == "unguarded" else who for who in COLORS}
WIDE = 130


def _ratio(value: float | None) -> str:
    return "–" if value is None else f"{value:.2f}"


SLIP: dict[str, Callable[[GripRow], str]] = {
    "slip": lambda one: f"{one.slips_deg['slipguard']:.1f}°",
    "oracle": lambda one: f"{one.slips_deg['oracle']:.1f}°",
    "fixed": lambda one: f"{one.slips_deg['fixed step']:.1f}°",
    "no guard": lambda one: f"{one.slips_deg['unguarded']:.1f}°",
    "/oracle": lambda one: _ratio(one.over_oracle),
    "p95": lambda one: _ratio(one.over_oracle_p95),
    "fixed/": lambda one: _ratio(one.fixed_over_slipguard),
}
GRIP: dict[str, Callable[[GripRow], str]] = {
    "force": lambda one: _ratio(one.force_over_needed),
    "arrest": lambda one: "–" if one.arrested_s is None else f"{one.arrested_s:.2f} s",
    "steps": lambda one: f"{one.steps_median:g}/{one.steps_max}",
    "early": lambda one: f"{100 * one.early:.0f}%",
    "dropped": lambda one: "/".join(str(one.drops[who]) for who in SHOWN),
    "stopped": lambda one: str(one.ended),
}


def print_tables(console: Console, found: GripCampaignResult) -> None:
    """Print the tables; on a narrow terminal two narrow ones instead of a wide one."""
    blocks = [(f"lifts with a grip that is too weak: {len(found.trials)} trials", _all_rows(found.trials))]
    tight = [*_split("high need", found.high_need), *_split("fragile", found.fragile)]
    if tight:
        count, most_n = len(found.high_need) + len(found.fragile), FRAGILE_MAX_N
        low, high = TIGHT_SHARES
        title = f"needed force {low:g} to {high:g} of the limit (fragile: {most_n:g} N), lift {HIGH_MM:g} mm: {count}"
        blocks.append((title, tight))
    if found.gone:
        blocks.append((f"support removed: {len(found.gone)} trials", _split("", found.gone)))
    for title, lines in blocks:
        parts = [SLIP, GRIP] if console.width < WIDE else [SLIP | GRIP]
        for columns in parts:
            console.print(_table(title if columns is parts[0] else "", lines, columns))
    figures, similar = as_json(found), agreement(found.trials)
    if similar is not None:
        console.print(
            f"rendered frames and error model on the same {similar.count} trials: mean slip "
            f"{similar.rendered_deg:.2f}° and {similar.model_deg:.2f}°, difference {100 * similar.apart:.0f} %; "
            f"median difference of a trial {similar.differs_deg:.2f}°"
        )
    console.print(_holds_text(found, figures))
    console.print(
        "slip: true rotation at the end without elastic torsion, median; ratios of slips by trial, "
        f"with at least {FLOOR_DEG:g}°; force: largest true over needed force; arrest: from the first slip to the "
        "last, median; steps: forces commanded after the first, median/maximum; early: tightened before any slip; "
        "dropped: slipguard/oracle/fixed step/no guard; stopped: in a fault or too low although the limit sufficed",
        style="dim",
    )
    console.print(_limits_table(figures))
    for line in remarks(figures):
        console.print(line, style="yellow")
    if not failures(figures):
        console.print("all limits are kept" + (", not in every group: see above" if remarks(figures) else ""))


def _all_rows(played: Sequence[TrialOutcomes]) -> list[GripRow]:
    """Return rows by first grip and of all: for all gels, then for each."""
    found = [*by_first_grip(played), row("all", played)]
    for gel in GELS:
        some = of_gel(played, gel)
        found += (
            [_titled(one, f"{gel}, {one.title}") for one in (*by_first_grip(some), row("all", some))] if some else []
        )
    return found


def _split(title: str, played: Sequence[TrialOutcomes]) -> list[GripRow]:
    rows = [*by_gel(played), row("all", played)] if played else []
    return [_titled(one, f"{title}, {one.title}" if title else one.title) for one in rows]


def _titled(one: GripRow, title: str) -> GripRow:
    return replace(one, title=title)


def _holds_text(found: GripCampaignResult, figures: dict[str, Any]) -> str:
    held = figures["holds"]
    text = (
        f"{held['count']} stable holds, {held['minutes']} minutes in total, {held['rendered']} with rendered frames: "
        f"{held['false_while_holding']} tightenings without slip after the lift, "
        f"{held['false_while_lifted']} during the lift, when the gel winds up; "
        f"{held['tightened_while_slipping']} while the object slipped"
    )
    failed = [f"{one.hold.trial.name}: {one.failed}" for one in found.holds if one.failed is not None]
    return "; ".join([text, *failed])


def _table(title: str, lines: list[GripRow], columns: dict[str, Callable[[GripRow], str]]) -> Table:
    table = _plain(title, ("", "n", *columns))
    for one in lines:
        table.add_row(one.title, str(one.count), *(column(one) for column in columns.values()))
    return table


def _limits_table(figures: dict[str, Any]) -> Table:
    table = _plain("limits", ("", "limit", "all", *(name.replace(" ", "\n") for name in GROUPS), "kept"))
    for check in checks(figures):
        values = [check.value, *(check.groups[group] for group in GROUPS)]
        shown = ["–" if value is None else f"{round(value, 2):g}" for value in values]
        table.add_row(check.bound.title, check.bound.allowed, *shown, "yes" if check.held else "NO")
    return table


def _plain(title: str, heads: Sequence[str]) -> Table:
    table = Table(
        title=title, box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False, title_justify="left", padding=(0, 1, 0, 0)
    )
    for name in heads:
        table.add_column(name, justify="right" if name else "left", no_wrap=True)
    return table


def draw(found: GripCampaignResult, path: Path) -> None:
    """Plot slip against first grip for all controllers, and one trial over time."""
    figure = plotting.figure(13.0, 5.0)
    left, right = figure.subfigures(1, 2, squeeze=False)[0]
    _scatter(left.subplots(), found)
    shown = [one.trial for one in found.trials if one.trial.share == SHARES[1] and not one.trial.soft]
    if shown:
        upper, lower = right.subplots(2, 1, sharex=True, height_ratios=(2, 1))
        _arrest(upper, lower, {who: run_trial(shown[0], who, traced=True) for who in COLORS}, shown[0].needed_n)
        upper.set_title(shown[0].name, fontsize=9)
    plotting.save(figure, path)


def _scatter(axes: Any, found: GripCampaignResult) -> None:
    """Plot a dot for a trial on a stiff gel, a cross for one on a soft gel."""
    for k, who in enumerate(COLORS):
        for soft, marker in ((False, "."), (True, "x")):
            played = [one for one in found.trials if one.trial.soft is soft]
            x = np.asarray([one.trial.share + 0.012 * (k - 1.5) for one in played])
            y = np.asarray([of(one, who).slip_deg for one in played])
            label = None if soft else NAMES[who]
            axes.plot(x, np.maximum(y, 0.01), marker, ms=4, alpha=0.5, color=COLORS[who], label=label)
    axes.set_yscale("log")
    axes.set_xlabel("first grip force / needed force (crosses: soft gel)")
    axes.set_ylabel("true slip at the end / °")
    axes.grid(alpha=0.3)
    axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=len(COLORS), fontsize=8)


def _arrest(upper: Any, lower: Any, outcomes: dict[ControllerName, TrialOutcome], needed_n: float) -> None:
    for who, outcome in outcomes.items():
        trace = outcome.trace
        if trace is None:
            continue
        time_s = [now.time_s - trace[0].time_s for now in trace]
        upper.plot(time_s, [abs(now.slip_deg) for now in trace], color=COLORS[who], label=NAMES[who])
        lower.plot(time_s, [now.force_n for now in trace], color=COLORS[who])
    lower.axhline(needed_n, color="black", lw=0.8, ls="--")
    upper.set_ylabel("true slip / °")
    lower.set_ylabel("force / N")
    lower.set_xlabel("time / s")
    upper.legend(fontsize=8)
    upper.grid(alpha=0.3)
    lower.grid(alpha=0.3)
