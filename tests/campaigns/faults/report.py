"""The fault campaign's result for people: what must not happen, each kind of fault, and the runs that failed."""

from __future__ import annotations

from collections.abc import Sequence

from rich.console import Console
from rich.table import Table

from tests.campaigns.faults.campaign import Campaign, KindTally
from tests.campaigns.faults.trial import TrialResult

SHOWN = 10
"""Failed runs that are told of; the others by seed."""


def show(console: Console, found: Campaign) -> None:
    """The tables."""
    head = Table(title=f"{found.runs} runs with one to three faults each")
    for name in ("avoidable drops", "openings", "presses", "unnamed faults", "crashes", "leaked tasks"):
        head.add_column(name, justify="right")
    safe = (found.drops_avoidable, found.openings, found.presses)
    figures = (*safe, found.unnamed_faults, found.crashes, found.leaked_tasks)
    head.add_row(*(str(figure) for figure in figures))
    console.print(head)
    kinds = Table(title="named in the log, from when it could be seen")
    for name in ("fault", "runs", "could be seen", "median", "longest", "not in time"):
        kinds.add_column(name, justify="left" if name == "fault" else "right")
    for name, tally in found.kinds.items():
        kinds.add_row(name, str(tally.runs), str(tally.due), *_times(tally), str(tally.unnamed or ""))
    console.print(kinds)
    if found.drops > found.drops_avoidable:
        console.print(
            f"{found.drops - found.drops_avoidable} further drops that holding would not have prevented", style="dim"
        )
    for outcome in found.failures[:SHOWN]:
        console.print(f"failed: {why(outcome)}", style="red", highlight=False)
    if len(found.failures) > SHOWN:
        rest = ", ".join(str(outcome.seed) for outcome in found.failures[SHOWN:])
        console.print(f"failed as well: seeds {rest}", style="red", highlight=False)
    if found.failures:
        console.print(f"play one again: python -m tests.campaigns faults --runs 1 --seed {found.failures[0].seed}")


def why(outcome: TrialResult) -> str:
    """One failed run in one line."""
    what = [
        f"dropped ({outcome.dropped})" if outcome.avoidable else "",
        f"{outcome.openings} openings" if outcome.openings else "",
        f"pressed harder in a stop of the arm, {outcome.presses} times" if outcome.presses else "",
        f"not named: {', '.join(outcome.unnamed)}" if outcome.unnamed else "",
        *outcome.crashes,
        f"tasks left: {', '.join(outcome.leaked)}" if outcome.leaked else "",
    ]
    plans = "; ".join(str(plan) for plan in outcome.plans)
    return f"seed {outcome.seed} ({outcome.object_name}; {plans}): {'; '.join(part for part in what if part)}"


def show_run(console: Console, outcome: TrialResult) -> None:
    """One run, line by line."""
    console.print(f"seed {outcome.seed}: {outcome.object_name}; " + "; ".join(str(plan) for plan in outcome.plans))
    for line in outcome.lines:
        console.print(line, highlight=False, markup=False)
    if outcome.dropped is not None:
        console.print(f"dropped: {outcome.dropped}")


def _times(tally: KindTally) -> Sequence[str]:
    if not tally.named_s:
        return "", ""
    in_order = sorted(tally.named_s)
    return f"{in_order[len(in_order) // 2]:.2f} s", f"{in_order[-1]:.2f} s"
