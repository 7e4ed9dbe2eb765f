"""Statistics of a campaign: final slip against force over needed, by controller and group.

All slips and forces are of lifts whose first grip is too weak, as far as the actuator can answer: where even the
clairvoyant bound slips far, the excess over its slip is stated. What starts firm is judged by whether it was tightened.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from slipguard.bench.grip.campaign import BASELINES, BOUND, REACTIVE, GripCampaignResult, ScenarioResult
from slipguard.bench.grip.lift_course import GripOutcome

FLOOR_DEG, FINE_FLOOR_DEG = 0.5, 0.1
"""Slips below these count as these in ratios, because a ratio of two tiny slips has no meaning."""


@dataclass(frozen=True, slots=True)
class ControllerRow:
    """One controller on some lifts. slip: rotation at the end; slide: translation; force: largest over needed."""

    controller: str
    count: int
    slip_median_deg: float
    slip_p95_deg: float
    slip_worst_deg: float
    slide_p95_mm: float
    slide_worst_mm: float
    drops: int
    force_median: float
    force_p95: float

    @classmethod
    def of(cls, controller: str, outcomes: Sequence[GripOutcome]) -> ControllerRow:
        slips = [float(v) for v in np.quantile([one.slip_deg for one in outcomes], (0.5, 0.95, 1.0))]
        slides = [float(v) for v in np.quantile([one.slide_mm for one in outcomes], (0.95, 1.0))]
        forces = [float(v) for v in np.quantile([one.force_over_needed for one in outcomes], (0.5, 0.95))]
        drops = sum(one.dropped is not None for one in outcomes)
        return cls(
            controller=controller,
            count=len(outcomes),
            slip_median_deg=slips[0],
            slip_p95_deg=slips[1],
            slip_worst_deg=slips[2],
            slide_p95_mm=slides[0],
            slide_worst_mm=slides[1],
            drops=drops,
            force_median=forces[0],
            force_p95=forces[1],
        )

    def dominates(self, other: ControllerRow) -> bool:
        """Return whether this one neither slips nor grips nor drops more, and one of these less."""
        mine, its = self._costs, other._costs
        return all(a <= b for a, b in zip(mine, its, strict=True)) and mine != its

    @property
    def _costs(self) -> tuple[float, ...]:
        """Slip and force, rounded to what the table shows: smaller differences decide nothing."""
        slips = (self.slip_p95_deg, self.slip_worst_deg, self.slide_p95_mm, self.slide_worst_mm)
        return (*(round(one, 1) for one in slips), self.drops, round(self.force_median, 2), round(self.force_p95, 2))

    def as_json(self) -> dict[str, object]:
        return {
            "controller": self.controller,
            "scenarios": self.count,
            "slip_median_deg": round(self.slip_median_deg, 3),
            "slip_p95_deg": round(self.slip_p95_deg, 3),
            "slip_worst_deg": round(self.slip_worst_deg, 3),
            "slide_p95_mm": round(self.slide_p95_mm, 3),
            "slide_worst_mm": round(self.slide_worst_mm, 3),
            "drops": self.drops,
            "force_over_needed_median": round(self.force_median, 3),
            "force_over_needed_p95": round(self.force_p95, 3),
        }


def pareto_rows(results: Sequence[ScenarioResult]) -> list[ControllerRow]:
    """Return a row of every controller; empty without results."""
    if not results:
        return []
    names = ("slipguard", BOUND, REACTIVE, *BASELINES)
    return [ControllerRow.of(name, [one.outcomes[name] for one in results]) for name in names]


def excess_over_bound(results: Iterable[ScenarioResult], bound: str = BOUND) -> list[tuple[float, float]]:
    """Return how much further slipguard's objects slipped than a bound's, in degrees and mm, by lift."""
    pairs = [(one.slipguard, one.outcomes[bound]) for one in results]
    return [(a.slip_deg - b.slip_deg, a.slide_mm - b.slide_mm) for a, b in pairs]


def dominated_by(rows: Sequence[ControllerRow]) -> list[str]:
    """Return the baselines that are better than slipguard in slip and in force."""
    ours = next((row for row in rows if row.controller == "slipguard"), None)
    return [row.controller for row in rows if row.controller in BASELINES and ours and row.dominates(ours)]


def groups(found: GripCampaignResult) -> dict[str, list[ScenarioResult]]:
    """Return the weak lifts by event, motion, pads and needed force."""
    weak = found.weak
    parts: dict[str, list[ScenarioResult]] = {}
    for one in weak:
        scenario = one.scenario
        share = scenario.needed_n / (scenario.pose.gripper.gain * scenario.force_max_n)
        need = "needs under 0.3 of the limit" if share < 0.3 else "0.3 to 0.6" if share < 0.6 else "over 0.6"
        for name in (scenario.event, f"{scenario.motion} motion", f"{scenario.pad} pads", need):
            parts.setdefault(name, []).append(one)
    return dict(sorted(parts.items()))


@dataclass(frozen=True, slots=True)
class FirmRow:
    """False tightenings of one controller on firm grasps.

    lifting: lifts that were tightened; held: forces later; holds: how many holds they belong to.
    """

    controller: str
    count: int
    lifting: int
    held: int
    holds: int
    force_median: float

    @property
    def tightened_share(self) -> float:
        return self.lifting / self.count

    @property
    def tightened_while_held_share(self) -> float:
        return self.holds / self.count


def firm_rows(firm: Sequence[ScenarioResult], names: Iterable[str]) -> list[FirmRow]:
    """Return a row of each of these controllers; empty without firm grasps. force: over the first grip."""
    if not firm:
        return []
    return [
        FirmRow(
            name,
            len(firm),
            sum(one.outcomes[name].tightenings > 0 for one in firm),
            sum(one.outcomes[name].held for one in firm),
            sum(one.outcomes[name].held > 0 for one in firm),
            float(np.median([one.outcomes[name].force_n / one.scenario.grip_n for one in firm])),
        )
        for name in names
    ]


def ratios(results: Iterable[ScenarioResult], upper: str, lower: str, floor_deg: float = FLOOR_DEG) -> list[float]:
    """Return slip ratios of two controllers by lift, without lifts that either dropped."""
    pairs = [(one.outcomes[upper], one.outcomes[lower]) for one in results]
    return [
        max(a.slip_deg, floor_deg) / max(b.slip_deg, floor_deg)
        for a, b in pairs
        if a.dropped is None and b.dropped is None
    ]


def drops_beyond_bound(results: Iterable[ScenarioResult]) -> int:
    """Return how many lifts slipguard dropped and the clairvoyant bound did not."""
    return sum(one.slipguard.dropped is not None and one.holdable for one in results)


def ended_without_need(results: Iterable[ScenarioResult]) -> int:
    """Return how many lifts slipguard ended in a fault or too low although the clairvoyant bound held the object."""
    return sum(
        one.holdable and one.slipguard.dropped is None and (one.slipguard.fault is not None or not one.slipguard.up)
        for one in results
    )


def rendered_difference(results: Iterable[ScenarioResult]) -> float | None:
    """Return the median difference of slipguard's force with rendered frames from that with the error model, relative.

    The force follows from everything that was perceived; the final slip is often 0 with both.
    """
    pairs = [(one.rendered.force_n, one.slipguard.force_n) for one in results if one.rendered is not None]
    return float(np.median([abs(a - b) / b for a, b in pairs])) if pairs else None


def median(values: Sequence[float]) -> float | None:
    """Return the median; None without values."""
    return float(np.median(values)) if values else None


def quantile(values: Sequence[float], q: float) -> float | None:
    """Return a quantile, q from 0 to 1; None without values."""
    return float(np.quantile(values, q)) if values else None
