"""The campaign's tables and its picture."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table

from slipguard.lab import figures as drawings
from slipguard.lab.grip.campaign import Found
from slipguard.lab.grip.figures import FLOOR_DEG, Row, agreement, as_json, rows
from slipguard.lab.grip.matrix import SHARES
from slipguard.lab.grip.play import Outcome, Who, play

COLOURS: dict[Who, str] = {
    "law": "tab:blue",
    "oracle": "tab:green",
    "fixed step": "tab:orange",
    "nobody": "tab:gray",
}
NAMES: dict[Who, str] = {"law": "slipguard", "oracle": "oracle", "fixed step": "fixed step", "nobody": "no guard"}


def print_tables(console: Console, found: Found) -> None:
    """For people."""
    console.print(_table(f"lifted too weakly gripped: {len(found.trials)} trials", rows(found.trials)))
    if found.gone:
        console.print(_table(f"the support goes away at once: {len(found.gone)} trials", rows(found.gone)))
    figures, alike = as_json(found), agreement(found.trials)
    console.print(
        f"stable holds: {figures['false_tightenings']} tightenings in {figures['hold_minutes']} minutes after the "
        f"lift; of the {figures['holds']} lifts into them {figures['hold_lifts_tightened']} were tightened while the "
        f"gel wound up, {figures['hold_lifts_tightened_stiff']} of these on a stiff gel"
    )
    if alike is not None:
        console.print(
            f"rendered frames against the error model, the same {alike.count} trials: mean slip "
            f"{alike.rendered_deg:.2f}° and {alike.model_deg:.2f}°, {100 * alike.apart:.0f} % apart; "
            f"median difference {alike.differs_deg:.2f}°"
        )
    console.print(
        "slip: true turn at the end less the gel's wind-up, median; ratios of slips trial by trial, "
        f"less than {FLOOR_DEG:g}° counted as that; force: highest true over needed; early: tightened before any slip; "
        "dropped: slipguard/oracle/fixed step/no guard",
        style="dim",
    )


def _table(title: str, lines: list[Row]) -> Table:
    table = Table(
        title=title, box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False, title_justify="left", padding=(0, 1, 0, 0)
    )
    heads = ("", "n", "slip", "oracle", "fixed", "none", "/orac", "p95", "fix/", "force", "early", "dropped")
    for name in heads:
        table.add_column(name, justify="right" if name else "left", no_wrap=True)
    for one in lines:
        drops = "/".join(str(one.drops[who]) for who in ("law", "oracle", "fixed step", "nobody"))
        table.add_row(
            one.title,
            str(one.count),
            *(f"{one.slips_deg[who]:.1f}°" for who in ("law", "oracle", "fixed step", "nobody")),
            *(_ratio(value) for value in (one.over_oracle, one.over_oracle_p95, one.fixed_over_law)),
            _ratio(one.force_over_needed),
            f"{100 * one.early:.0f}%",
            drops,
        )
    return table


def _ratio(value: float | None) -> str:
    return "–" if value is None else f"{value:.2f}"


def draw(found: Found, path: Path) -> None:
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


def _scatter(axes: Any, found: Found) -> None:
    for k, who in enumerate(COLOURS):
        points = [
            (share + 0.012 * (k - 1.5), (one.law if who == "law" else one.outcomes[who]).slip_deg)
            for share in SHARES
            for one in found.trials
            if one.trial.share == share
        ]
        x, y = np.asarray(points).T
        axes.plot(x, np.maximum(y, 0.01), ".", ms=4, alpha=0.5, color=COLOURS[who], label=NAMES[who])
    axes.set_yscale("log")
    axes.set_xlabel("first grip / grip needed")
    axes.set_ylabel("true slip at the end / °")
    axes.grid(alpha=0.3)
    axes.legend()


def _arrest(upper: Any, lower: Any, outcomes: dict[Who, Outcome], needed_n: float) -> None:
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
