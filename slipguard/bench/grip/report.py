"""The campaign's tables and its picture."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table

from slipguard.bench.grip.campaign import CampaignResult, TrialOutcomes
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
from slipguard.bench.grip.trial_run import HIGH_MM, ControllerName, TrialOutcome, play
from slipguard.bench.grip.trials import FRAGILE_MAX_N, SHARES, TIGHT_SHARES
from slipguard.tools import plotting as drawings

COLOURS: dict[ControllerName, str] = {
    "law": "tab:blue",
    "oracle": "tab:green",
    "fixed step": "tab:orange",
    "nobody": "tab:gray",
}
NAMES: dict[ControllerName, str] = {
    "law": "slipguard",
    "oracle": "oracle",
    "fixed step": "fixed step",
    "nobody": "no guard",
}


WIDE = 130


def _ratio(value: float | None) -> str:
    return "–" if value is None else f"{value:.2f}"


SLIP: dict[str, Callable[[GripRow], str]] = {
    "slip": lambda one: f"{one.slips_deg['law']:.1f}°",
    "oracle": lambda one: f"{one.slips_deg['oracle']:.1f}°",
    "fixed": lambda one: f"{one.slips_deg['fixed step']:.1f}°",
    "none": lambda one: f"{one.slips_deg['nobody']:.1f}°",
    "/oracle": lambda one: _ratio(one.over_oracle),
    "p95": lambda one: _ratio(one.over_oracle_p95),
    "fixed/": lambda one: _ratio(one.fixed_over_law),
}
GRIP: dict[str, Callable[[GripRow], str]] = {
    "force": lambda one: _ratio(one.force_over_needed),
    "arrest": lambda one: "–" if one.arrested_s is None else f"{one.arrested_s:.2f} s",
    "steps": lambda one: f"{one.steps_median:g}/{one.steps_max}",
    "early": lambda one: f"{100 * one.early:.0f}%",
    "dropped": lambda one: "/".join(str(one.drops[who]) for who in SHOWN),
    "given up": lambda one: str(one.ended),
}


def print_tables(console: Console, found: CampaignResult) -> None:
    """For people; two narrow tables for one wide one where the terminal is narrow."""
    blocks = [(f"lifted too weakly gripped: {len(found.trials)} trials", _all_rows(found.trials))]
    tight = [*_split("high need", found.high_need), *_split("fragile", found.fragile)]
    if tight:
        count, most_n = len(found.high_need) + len(found.fragile), FRAGILE_MAX_N
        low, high = TIGHT_SHARES
        title = f"need {low:g} to {high:g} of the budget (fragile: {most_n:g} N), lifted {HIGH_MM:g} mm: {count} trials"
        blocks.append((title, tight))
    if found.gone:
        blocks.append((f"the support goes away at once: {len(found.gone)} trials", _split("", found.gone)))
    for title, lines in blocks:
        parts = [SLIP, GRIP] if console.width < WIDE else [SLIP | GRIP]
        for columns in parts:
            console.print(_table(title if columns is parts[0] else "", lines, columns))
    figures, alike = as_json(found), agreement(found.trials)
    if alike is not None:
        console.print(
            f"rendered frames against the error model, the same {alike.count} trials: mean slip "
            f"{alike.rendered_deg:.2f}° and {alike.model_deg:.2f}°, {100 * alike.apart:.0f} % apart; "
            f"median difference {alike.differs_deg:.2f}°"
        )
    console.print(_said_of_holds(found, figures))
    console.print(
        "slip: true turn at the end less the gel's wind-up, median; ratios of slips trial by trial, "
        f"less than {FLOOR_DEG:g}° counted as that; force: highest true over needed; arrest: from the first slip to "
        "the last, median; steps: forces commanded after the first, median/most; early: tightened before any slip; "
        "dropped: slipguard/oracle/fixed step/no guard; given up: in a fault or too low, though the budget sufficed",
        style="dim",
    )
    console.print(_verdict(figures))
    for line in remarks(figures):
        console.print(line, style="yellow")
    if not failures(figures):
        console.print("held on the whole" + (", not everywhere: see above" if remarks(figures) else ""))


def _all_rows(played: Sequence[TrialOutcomes]) -> list[GripRow]:
    """By first grip and all together: of all gels, then of each."""
    found = [*by_first_grip(played), row("all", played)]
    for gel in GELS:
        some = of_gel(played, gel)
        found += (
            [_titled(one, f"{gel}, {one.title}") for one in (*by_first_grip(some), row("all", some))] if some else []
        )
    return found


def _split(title: str, played: Sequence[TrialOutcomes]) -> list[GripRow]:
    """By gel and all together."""
    rows = [*by_gel(played), row("all", played)] if played else []
    return [_titled(one, f"{title}, {one.title}" if title else one.title) for one in rows]


def _titled(one: GripRow, title: str) -> GripRow:
    return replace(one, title=title)


def _said_of_holds(found: CampaignResult, figures: dict[str, Any]) -> str:
    held = figures["holds"]
    text = (
        f"stable holds, {held['count']} of {held['minutes']} minutes in all, {held['rendered']} of them rendered: "
        f"{held['false_while_holding']} tightenings after the lift while nothing slipped, "
        f"{held['false_while_lifted']} in the lifts into them, as the gel wound up; "
        f"{held['tightened_while_slipping']} while something did slip"
    )
    failed = [f"{one.hold.trial.name}: {one.failed}" for one in found.holds if one.failed is not None]
    return "; ".join([text, *failed])


def _table(title: str, lines: list[GripRow], columns: dict[str, Callable[[GripRow], str]]) -> Table:
    table = _plain(title, ("", "n", *columns))
    for one in lines:
        table.add_row(one.title, str(one.count), *(column(one) for column in columns.values()))
    return table


def _verdict(figures: dict[str, Any]) -> Table:
    """Every promise: what is allowed, and what was found on the whole and by group."""
    table = _plain("promised", ("", "allowed", "all", *GROUPS, "held"))
    for check in checks(figures):
        values = [check.value, *(check.groups[group] for group in GROUPS)]
        shown = ["–" if value is None else f"{value:.3g}" for value in values]
        table.add_row(check.bound.title, check.bound.allowed, *shown, "yes" if check.held else "NO")
    return table


def _plain(title: str, heads: Sequence[str]) -> Table:
    table = Table(
        title=title, box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False, title_justify="left", padding=(0, 1, 0, 0)
    )
    for name in heads:
        table.add_column(name, justify="right" if name else "left", no_wrap=True)
    return table


def draw(found: CampaignResult, path: Path) -> None:
    """Slip against first grip for everybody, and one arrest over time."""
    drawing = drawings.figure(13.0, 5.0)
    left, right = drawing.subfigures(1, 2, squeeze=False)[0]
    _scatter(left.subplots(), found)
    shown = [one.trial for one in found.trials if one.trial.share == SHARES[1] and not one.trial.soft]
    if shown:
        upper, lower = right.subplots(2, 1, sharex=True, height_ratios=(2, 1))
        _arrest(upper, lower, {who: play(shown[0], who, traced=True) for who in COLOURS}, shown[0].needed_n)
        upper.set_title(shown[0].name, fontsize=9)
    drawings.save(drawing, path)


def _scatter(axes: Any, found: CampaignResult) -> None:
    """A dot for a trial on a stiff gel, a cross for one on a soft gel."""
    for k, who in enumerate(COLOURS):
        for soft, marker in ((False, "."), (True, "x")):
            played = [one for one in found.trials if one.trial.soft is soft]
            x = np.asarray([one.trial.share + 0.012 * (k - 1.5) for one in played])
            y = np.asarray([of(one, who).slip_deg for one in played])
            label = None if soft else NAMES[who]
            axes.plot(x, np.maximum(y, 0.01), marker, ms=4, alpha=0.5, color=COLOURS[who], label=label)
    axes.set_yscale("log")
    axes.set_xlabel("first grip / grip needed (crosses: soft gel)")
    axes.set_ylabel("true slip at the end / °")
    axes.grid(alpha=0.3)
    axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=len(COLOURS), fontsize=8)


def _arrest(upper: Any, lower: Any, outcomes: dict[ControllerName, TrialOutcome], needed_n: float) -> None:
    for who, outcome in outcomes.items():
        trace = outcome.trace
        if trace is None:
            continue
        time_s = np.asarray(trace.time_s) - trace.time_s[0]
        upper.plot(time_s, np.abs(trace.slip_deg), color=COLOURS[who], label=NAMES[who])
        lower.plot(time_s, trace.force_n, color=COLOURS[who])
    lower.axhline(needed_n, color="black", lw=0.8, ls="--")
    upper.set_ylabel("true slip / °")
    lower.set_ylabel("force / N")
    lower.set_xlabel("time / s")
    upper.legend(fontsize=8)
    upper.grid(alpha=0.3)
    lower.grid(alpha=0.3)
