"""Statistics of a group of trials.

Slips are compared as ratios; a slip below `FLOOR_DEG` counts as this, because a ratio of two tiny slips has no meaning.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from slipguard.bench.grip.campaign import TrialOutcomes
from slipguard.bench.grip.trial_run import ControllerName, TrialOutcome
from slipguard.bench.grip.trials import SHARES
from slipguard.control.params import GuardParams

FLOOR_DEG = 0.5
GELS = {"stiff": False, "soft": True}
JSON_NAMES: dict[ControllerName, str] = {
    "slipguard": "law",
    "oracle": "oracle",
    "fixed step": "fixed step",
    "unguarded": "nobody",
}
"""Keys of the controllers in the public JSON."""
SHOWN: tuple[ControllerName, ...] = ("slipguard", "oracle", "fixed step", "unguarded")


@dataclass(frozen=True, slots=True)
class GripRow:
    """Statistics of some trials. Ratios and times are medians unless named otherwise; None without values.

    Attributes:
        slips_deg: Median true slip at the end by controller; drops: their number by controller.
        avoidable: Drops that a guard with this gripper could have prevented.
        ended: Trials that ended in a fault or below the goal although the force limit was sufficient.
        over_oracle: slipguard's slip relative to the oracle's; fixed_over_slipguard: the fixed step's to slipguard's.
        arrested_s: Time from the first slip to the last, where slipguard stopped a slip.
        steps_median: Forces commanded after the first grip.
        early: Share of trials in which slipguard tightened before any slip.
    """

    title: str
    count: int
    slips_deg: dict[ControllerName, float]
    drops: dict[ControllerName, int]
    avoidable: int
    ended: int
    over_oracle: float | None
    over_oracle_p95: float | None
    fixed_over_slipguard: float | None
    force_over_needed: float
    arrested_s: float | None
    arrested_max_s: float | None
    steps_median: float
    steps_max: int
    early: float

    def as_json(self) -> dict[str, object]:
        return {
            "scenarios": self.count,
            "slip_deg_median": {JSON_NAMES[name]: round(slip_deg, 3) for name, slip_deg in self.slips_deg.items()},
            "drops": {JSON_NAMES[name]: count for name, count in self.drops.items()},
            "drops_avoidable": self.avoidable,
            "ended_without_need": self.ended,
            "turn_over_oracle_median": rounded(self.over_oracle),
            "turn_over_oracle_p95": rounded(self.over_oracle_p95),
            "fixed_step_turn_over_ours_median": rounded(self.fixed_over_slipguard),
            "force_over_needed_median": rounded(self.force_over_needed),
            "arrest_s_median": rounded(self.arrested_s),
            "arrest_s_max": rounded(self.arrested_max_s),
            "steps_median": self.steps_median,
            "steps_max": self.steps_max,
            "tightened_before_any_slip": rounded(self.early),
        }


def row(title: str, played: Sequence[TrialOutcomes]) -> GripRow:
    over = ratios(played, "slipguard", "oracle")
    arrests = [
        one.slipguard.arrested_s
        for one in played
        if one.slipguard.arrested_s is not None and one.slipguard.dropped is None
    ]
    steps = [one.slipguard.tightenings for one in played]
    return GripRow(
        title=title,
        count=len(played),
        slips_deg={who: float(np.median([of(one, who).slip_deg for one in played])) for who in SHOWN},
        drops={who: sum(of(one, who).dropped is not None for one in played) for who in SHOWN},
        avoidable=sum(avoidable_drop(one) for one in played),
        ended=sum(avoidable_end(one) for one in played),
        over_oracle=median(over),
        over_oracle_p95=float(np.quantile(over, 0.95)) if over else None,
        fixed_over_slipguard=median(ratios(played, "fixed step", "slipguard")),
        force_over_needed=float(np.median([one.slipguard.force_over_needed for one in played])),
        arrested_s=median(arrests),
        arrested_max_s=max(arrests, default=None),
        steps_median=float(np.median(steps)),
        steps_max=max(steps),
        early=sum(one.slipguard.early for one in played) / len(played),
    )


def by_first_grip(played: Sequence[TrialOutcomes]) -> list[GripRow]:
    parts = [(f"grip {share:.2f}", [one for one in played if one.trial.share == share]) for share in SHARES]
    return [row(title, part) for title, part in parts if part]


def by_gel(played: Sequence[TrialOutcomes]) -> list[GripRow]:
    return [row(f"{gel} gel", part) for gel in GELS if (part := of_gel(played, gel))]


def of_gel(played: Sequence[TrialOutcomes], gel: str) -> list[TrialOutcomes]:
    return [one for one in played if one.trial.soft is GELS[gel]]


def of(one: TrialOutcomes, who: ControllerName) -> TrialOutcome:
    """Return the outcome of one controller; that of slipguard with rendered frames if there is one."""
    return one.slipguard if who == "slipguard" else one.outcomes[who]


def ratios(
    played: Iterable[TrialOutcomes], upper: ControllerName, lower: ControllerName, floor_deg: float = FLOOR_DEG
) -> list[float]:
    """Return slip ratios of two controllers by trial, without trials that either dropped."""
    pairs = [(of(one, upper), of(one, lower)) for one in played]
    return [
        max(a.slip_deg, floor_deg) / max(b.slip_deg, floor_deg)
        for a, b in pairs
        if a.dropped is None and b.dropped is None
    ]


def avoidable_drop(one: TrialOutcomes) -> bool:
    """Return whether slipguard dropped the object although the needed force is within the force limit.

    If the support was removed, the oracle must have held it: some objects fall before any motor can act.
    """
    return any(one_outcome.dropped is not None for one_outcome in _slipguard_outcomes(one)) and not _unavoidable(one)


def avoidable_end(one: TrialOutcomes) -> bool:
    """Return whether slipguard ended in a fault or too low although the needed force is within the force limit.

    If the support was removed, the oracle's rotation must have stayed below slipguard's limit.
    """
    ended = any(
        one_outcome.dropped is None and (one_outcome.fault is not None or not one_outcome.up)
        for one_outcome in _slipguard_outcomes(one)
    )
    return ended and not _unavoidable(one, GuardParams().tuning.rotation_max_deg)


def _unavoidable(one: TrialOutcomes, rotation_deg: float = math.inf) -> bool:
    oracle = one.outcomes["oracle"]
    return one.trial.event == "support gone" and (oracle.dropped is not None or oracle.rotation_deg > rotation_deg)


def _slipguard_outcomes(one: TrialOutcomes) -> list[TrialOutcome]:
    return [one.outcomes["slipguard"], *([] if one.rendered is None else [one.rendered])]


def median(values: Sequence[float]) -> float | None:
    return float(np.median(values)) if values else None


def rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 3)
