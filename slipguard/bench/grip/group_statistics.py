"""Statistics of a group of trials."""

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
SHOWN: tuple[ControllerName, ...] = ("law", "oracle", "fixed step", "nobody")


@dataclass(frozen=True, slots=True)
class GripRow:
    """Some trials together. slips: median true slip at the end, degrees; drops: by who. Ratios: medians but p95.

    arrested: seconds from the first slip to the last, of the trials in which the law stopped a slip. steps: forces
    commanded after the first grip. early: share of the trials in which the law tightened before anything had slipped.
    avoidable: drops that a guard with this gripper could have prevented; ended: trials that ended in a fault or below
    the goal without need. None: nothing to compare.
    """

    title: str
    count: int
    slips_deg: dict[ControllerName, float]
    drops: dict[ControllerName, int]
    avoidable: int
    ended: int
    over_oracle: float | None
    over_oracle_p95: float | None
    fixed_over_law: float | None
    force_over_needed: float
    arrested_s: float | None
    arrested_max_s: float | None
    steps_median: float
    steps_max: int
    early: float

    def as_json(self) -> dict[str, object]:
        """The same for a program."""
        return {
            "scenarios": self.count,
            "slip_deg_median": {who: round(slip_deg, 3) for who, slip_deg in self.slips_deg.items()},
            "drops": dict(self.drops),
            "drops_avoidable": self.avoidable,
            "ended_without_need": self.ended,
            "turn_over_oracle_median": rounded(self.over_oracle),
            "turn_over_oracle_p95": rounded(self.over_oracle_p95),
            "fixed_step_turn_over_ours_median": rounded(self.fixed_over_law),
            "force_over_needed_median": rounded(self.force_over_needed),
            "arrest_s_median": rounded(self.arrested_s),
            "arrest_s_max": rounded(self.arrested_max_s),
            "steps_median": self.steps_median,
            "steps_max": self.steps_max,
            "tightened_before_any_slip": rounded(self.early),
        }


def row(title: str, played: Sequence[TrialOutcomes]) -> GripRow:
    """The figures of some trials, of one at least."""
    over = ratios(played, "law", "oracle")
    arrests = [one.law.arrested_s for one in played if one.law.arrested_s is not None and one.law.dropped is None]
    steps = [one.law.tightenings for one in played]
    return GripRow(
        title=title,
        count=len(played),
        slips_deg={who: float(np.median([of(one, who).slip_deg for one in played])) for who in SHOWN},
        drops={who: sum(of(one, who).dropped is not None for one in played) for who in SHOWN},
        avoidable=sum(dropped_for_nothing(one) for one in played),
        ended=sum(ended_for_nothing(one) for one in played),
        over_oracle=median(over),
        over_oracle_p95=float(np.quantile(over, 0.95)) if over else None,
        fixed_over_law=median(ratios(played, "fixed step", "law")),
        force_over_needed=float(np.median([one.law.force_over_needed for one in played])),
        arrested_s=median(arrests),
        arrested_max_s=max(arrests, default=None),
        steps_median=float(np.median(steps)),
        steps_max=max(steps),
        early=sum(one.law.early for one in played) / len(played),
    )


def by_first_grip(played: Sequence[TrialOutcomes]) -> list[GripRow]:
    """One for each first grip there is."""
    parts = [(f"grip {share:.2f}", [one for one in played if one.trial.share == share]) for share in SHARES]
    return [row(title, part) for title, part in parts if part]


def by_gel(played: Sequence[TrialOutcomes]) -> list[GripRow]:
    """One for each gel there is."""
    return [row(f"{gel} gel", part) for gel in GELS if (part := of_gel(played, gel))]


def of_gel(played: Sequence[TrialOutcomes], gel: str) -> list[TrialOutcomes]:
    """Those on one gel."""
    return [one for one in played if one.trial.soft is GELS[gel]]


def of(one: TrialOutcomes, who: ControllerName) -> TrialOutcome:
    """How it went for one; for the law with rendered frames where there are some."""
    return one.law if who == "law" else one.outcomes[who]


def ratios(
    played: Iterable[TrialOutcomes], upper: ControllerName, lower: ControllerName, floor_deg: float = FLOOR_DEG
) -> list[float]:
    """Slip of one over slip of the other, trial by trial; without those that either dropped."""
    pairs = [(of(one, upper), of(one, lower)) for one in played]
    return [
        max(a.slip_deg, floor_deg) / max(b.slip_deg, floor_deg)
        for a, b in pairs
        if a.dropped is None and b.dropped is None
    ]


def dropped_for_nothing(one: TrialOutcomes) -> bool:
    """The law lost it, though the force needed is within the budget.

    Where the support goes at once only if the oracle, with the same gripper, kept it: some are gone before any motor
    can act.
    """
    return any(law.dropped is not None for law in _laws(one)) and not _beyond_help(one)


def ended_for_nothing(one: TrialOutcomes) -> bool:
    """The law ended in a fault, or never lifted it as high as told, though the force needed is within the budget.

    Where the support goes at once only if the oracle's turn stayed within what the law gives up at.
    """
    ended = any(law.dropped is None and (law.fault is not None or not law.up) for law in _laws(one))
    return ended and not _beyond_help(one, GuardParams().tuning.rotation_max_deg)


def _beyond_help(one: TrialOutcomes, rotation_deg: float = math.inf) -> bool:
    oracle = one.outcomes["oracle"]
    return one.trial.event == "support gone" and (oracle.dropped is not None or oracle.rotation_deg > rotation_deg)


def _laws(one: TrialOutcomes) -> list[TrialOutcome]:
    return [one.outcomes["law"], *([] if one.rendered is None else [one.rendered])]


def median(values: Sequence[float]) -> float | None:
    """None of nothing."""
    return float(np.median(values)) if values else None


def rounded(value: float | None) -> float | None:
    """To three digits."""
    return None if value is None else round(value, 3)
