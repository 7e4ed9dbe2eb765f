"""The campaign in figures.

Slips are compared as ratios; a slip below `FLOOR_DEG` counts as that much, for a ratio of two noughts means nothing.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from slipguard.lab.grip.campaign import Found, Played
from slipguard.lab.grip.matrix import SHARES
from slipguard.lab.grip.play import Outcome, Who

FLOOR_DEG = 0.5
FINE_FLOOR_DEG = 0.1
"""Below this the oracle itself sees nothing; reported beside the other."""


@dataclass(frozen=True, slots=True)
class Row:
    """Some trials together. slips: median true slip at the end, degrees; drops: by who. Ratios: medians but p95.

    early: share of the trials in which the law tightened before anything had slipped. None: nothing to compare.
    """

    title: str
    count: int
    slips_deg: dict[Who, float]
    drops: dict[Who, int]
    over_oracle: float | None
    over_oracle_p95: float | None
    fixed_over_law: float | None
    force_over_needed: float
    arrested_s: float | None
    early: float


def ratios(played: Iterable[Played], upper: Who, lower: Who, floor_deg: float = FLOOR_DEG) -> list[float]:
    """Slip of one over slip of the other, trial by trial; without those that either dropped."""
    pairs = [(_slip_deg(one, upper), _slip_deg(one, lower)) for one in played]
    return [max(a, floor_deg) / max(b, floor_deg) for a, b in pairs if a is not None and b is not None]


def row(title: str, played: Sequence[Played]) -> Row:
    """The figures of some trials."""
    everybody: tuple[Who, ...] = ("law", "oracle", "fixed step", "nobody")
    over = ratios(played, "law", "oracle")
    arrests = [one.law.arrested_s for one in played if one.law.arrested_s is not None and one.law.dropped is None]
    return Row(
        title=title,
        count=len(played),
        slips_deg={who: float(np.median([_outcome(one, who).slip_deg for one in played])) for who in everybody},
        drops={who: sum(_outcome(one, who).dropped is not None for one in played) for who in everybody},
        over_oracle=_median(over),
        over_oracle_p95=float(np.quantile(over, 0.95)) if over else None,
        fixed_over_law=_median(ratios(played, "fixed step", "law")),
        force_over_needed=float(np.median([one.law.force_over_needed for one in played])),
        arrested_s=_median(arrests),
        early=sum(one.law.early for one in played) / max(len(played), 1),
    )


def rows(played: Sequence[Played]) -> list[Row]:
    """One for each first grip, each gel, and all together."""
    found = [
        row(f"grip {share:.2f}", some)
        for share in SHARES
        if (some := [one for one in played if one.trial.share == share])
    ]
    for soft in (False, True):
        some = [one for one in played if one.trial.soft is soft]
        found += [row("soft gel" if soft else "stiff gel", some)] if some else []
    return [*found, row("all", played)]


@dataclass(frozen=True, slots=True)
class Agreement:
    """Rendered frames against the error model, on the same trials: mean final slip of each, and how far apart."""

    count: int
    rendered_deg: float
    model_deg: float
    apart: float
    differs_deg: float


def agreement(played: Sequence[Played]) -> Agreement | None:
    """None without rendered trials. apart: relative difference of the means; differs_deg: median trial by trial."""
    pairs = [(one.rendered.slip_deg, one.outcomes["law"].slip_deg) for one in played if one.rendered is not None]
    if not pairs:
        return None
    rendered, model = np.asarray(pairs).T
    mean = float(model.mean())
    apart = abs(float(rendered.mean()) - mean) / max(mean, FINE_FLOOR_DEG)
    return Agreement(len(pairs), float(rendered.mean()), mean, apart, float(np.median(np.abs(rendered - model))))


def as_json(found: Found) -> dict[str, object]:
    """The figures a program asks for: first the promised ones, then what explains them."""
    everything, alike = row("all", found.trials), agreement(found.trials)
    weakest = [one for one in found.trials if one.trial.share == SHARES[0]]
    gone = row("support gone", found.gone) if found.gone else None
    fine = ratios(found.trials, "law", "oracle", FINE_FLOOR_DEG)
    seconds = sum(one.seconds for one in found.holds)
    return {
        "scenarios": len(found.trials),
        "rendered": sum(one.rendered is not None for one in found.trials),
        "drops_avoidable": everything.drops["law"],
        "turn_over_oracle_median": _rounded(everything.over_oracle),
        "turn_over_oracle_p95": _rounded(everything.over_oracle_p95),
        "fixed_step_turn_over_ours_median": _rounded(everything.fixed_over_law),
        "false_tightenings": sum(one.tightenings for one in found.holds),
        "force_over_needed_median": _rounded(everything.force_over_needed),
        "fixed_step_turn_over_ours_at_0_97": _rounded(_median(ratios(weakest, "fixed step", "law"))),
        "slip_floor_deg": FLOOR_DEG,
        "turn_over_oracle_median_floor_0_1": _rounded(_median(fine)),
        "turn_over_oracle_p95_floor_0_1": _rounded(float(np.quantile(fine, 0.95)) if fine else None),
        "hold_minutes": round(seconds / 60.0, 1),
        "hold_lifts_tightened": sum(one.lifting > 0 for one in found.holds),
        "hold_lifts_tightened_stiff": sum(one.lifting > 0 and not one.hold.trial.soft for one in found.holds),
        "holds": len(found.holds),
        "rendered_against_model": _rounded(alike.apart if alike is not None else None),
        "support_gone": None
        if gone is None
        else {
            "scenarios": gone.count,
            "drops": gone.drops,
            "turn_over_oracle_median": _rounded(gone.over_oracle),
            "turn_over_oracle_p95": _rounded(gone.over_oracle_p95),
            "fixed_step_turn_over_ours_median": _rounded(gone.fixed_over_law),
        },
    }


def failures(figures: dict[str, object]) -> list[str]:
    """What must not be: an object dropped that holding could have kept, a grip tightened for nothing."""
    found = []
    if figures["drops_avoidable"]:
        found.append(f"{figures['drops_avoidable']} objects dropped whose needed force is within the budget")
    if figures["false_tightenings"]:
        found.append(f"{figures['false_tightenings']} tightenings in stable holds")
    return found


def _outcome(one: Played, who: Who) -> Outcome:
    return one.law if who == "law" else one.outcomes[who]


def _slip_deg(one: Played, who: Who) -> float | None:
    outcome = _outcome(one, who)
    return None if outcome.dropped is not None else outcome.slip_deg


def _median(values: list[float]) -> float | None:
    return float(np.median(values)) if values else None


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 3)
