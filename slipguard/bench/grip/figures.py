"""Statistics of a campaign: final slip against force over needed, by controller and group.

All slips and forces are of lifts whose first grip is too weak, as far as the actuator can answer: where even the
clairvoyant bound slips far, the excess over its slip is stated. What starts firm is judged by whether it was tightened.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass

import numpy as np

from slipguard.bench.grip.campaign import BASELINES, BOUND, NAIVE, REACTIVE, GripCampaignResult, ScenarioResult
from slipguard.bench.grip.disturbances import DISTURBANCES
from slipguard.bench.grip.lift_course import GripOutcome

FLOOR_DEG, FINE_FLOOR_DEG = 0.5, 0.1
"""Slips below these count as these in ratios, because a ratio of two tiny slips has no meaning."""
TIGHTENED = 1.01
"""Force after a disturbance over the one before, from which the grip counts as tightened."""


@dataclass(frozen=True, slots=True)
class ControllerRow:
    """One controller on some lifts. slip: rotation at the end; slide: translation; force: largest over needed."""

    controller: str
    scenarios: int
    slip_median_deg: float
    slip_p95_deg: float
    slip_worst_deg: float
    slide_p95_mm: float
    slide_worst_mm: float
    drops: int
    force_over_needed_median: float
    force_over_needed_p95: float

    @classmethod
    def of(cls, controller: str, outcomes: Sequence[GripOutcome]) -> ControllerRow:
        slips = np.quantile([one.slip_deg for one in outcomes], (0.5, 0.95, 1.0))
        slides = np.quantile([one.slide_mm for one in outcomes], (0.95, 1.0))
        forces = np.quantile([one.force_over_needed for one in outcomes], (0.5, 0.95))
        return cls(
            controller=controller,
            scenarios=len(outcomes),
            slip_median_deg=round(float(slips[0]), 3),
            slip_p95_deg=round(float(slips[1]), 3),
            slip_worst_deg=round(float(slips[2]), 3),
            slide_p95_mm=round(float(slides[0]), 3),
            slide_worst_mm=round(float(slides[1]), 3),
            drops=sum(one.dropped is not None for one in outcomes),
            force_over_needed_median=round(float(forces[0]), 3),
            force_over_needed_p95=round(float(forces[1]), 3),
        )

    def dominates(self, other: ControllerRow) -> bool:
        """Return whether this one neither slips nor grips nor drops more, and one of these less."""
        mine, its = self._costs, other._costs
        return all(a <= b for a, b in zip(mine, its, strict=True)) and mine != its

    @property
    def _costs(self) -> tuple[float, ...]:
        """Slip and force, rounded to what the table shows: smaller differences decide nothing."""
        slips = (self.slip_p95_deg, self.slip_worst_deg, self.slide_p95_mm, self.slide_worst_mm)
        forces = (self.force_over_needed_median, self.force_over_needed_p95)
        return (*(round(one, 1) for one in slips), self.drops, *(round(one, 2) for one in forces))

    def as_json(self) -> dict[str, object]:
        return asdict(self)


def pareto_rows(results: Sequence[ScenarioResult]) -> list[ControllerRow]:
    """Return a row of every controller, and two of the lifts that were also rendered; empty without results."""
    if not results:
        return []
    names = ("slipguard", BOUND, REACTIVE, *BASELINES)
    rows = [ControllerRow.of(name, [one.outcomes[name] for one in results]) for name in names]
    seen = [one for one in results if one.rendered is not None]
    if seen:
        rows.append(ControllerRow.of("rendered images", [one.rendered for one in seen if one.rendered is not None]))
        rows.append(ControllerRow.of("the same, modeled", [one.slipguard for one in seen]))
    return rows


def excess_over_bound(results: Iterable[ScenarioResult], bound: str = BOUND) -> list[tuple[float, float]]:
    """Return how much further slipguard's objects slipped than a bound's, in degrees and mm, by lift."""
    pairs = [(one.slipguard, one.outcomes[bound]) for one in results]
    return [(a.slip_deg - b.slip_deg, a.slide_mm - b.slide_mm) for a, b in pairs]


def dominated_by(rows: Sequence[ControllerRow]) -> list[str]:
    """Return the baselines that are better than slipguard in slip and in force."""
    ours = next((row for row in rows if row.controller == "slipguard"), None)
    return [row.controller for row in rows if row.controller in BASELINES and ours and row.dominates(ours)]


def naive_at_equal_force(rows: Sequence[ControllerRow]) -> dict[str, float] | None:
    """Return the slip p95 that the naive law has at slipguard's median force, between the two nearest of its gains.

    Beyond the range of its gains the nearest one counts. None without rows.
    """
    ours = next((row for row in rows if row.controller == "slipguard"), None)
    naive = sorted((row for row in rows if row.controller in NAIVE), key=lambda row: row.force_over_needed_median)
    if ours is None or not naive:
        return None
    forces = [row.force_over_needed_median for row in naive]
    force = min(max(ours.force_over_needed_median, forces[0]), forces[-1])
    slip_deg = float(np.interp(force, forces, [row.slip_p95_deg for row in naive]))
    ratio = ours.slip_p95_deg / slip_deg if slip_deg > 0.0 else math.inf
    return {
        "force_over_needed_median": round(force, 3),
        "naive_slip_p95_deg": round(slip_deg, 3),
        "slip_p95_deg": ours.slip_p95_deg,
        "ratio": round(ratio, 3),
    }


def groups(found: GripCampaignResult) -> dict[str, list[ScenarioResult]]:
    """Return the weak lifts by event, motion, pads and needed force."""
    parts: dict[str, list[ScenarioResult]] = {}
    for one in found.weak:
        scenario = one.scenario
        share = scenario.needed_n / (scenario.pose.gripper.gain * scenario.force_max_n)
        need = "needs under 0.3" if share < 0.3 else "0.3 to 0.6" if share < 0.6 else "over 0.6"
        for name in (scenario.event, f"{scenario.motion} motion", f"{scenario.pad} pads", need):
            parts.setdefault(name, []).append(one)
    return dict(sorted(parts.items()))


@dataclass(frozen=True, slots=True)
class FirmRow:
    """False tightenings of one controller on firm grasps. force_p95: largest force over the first grip."""

    controller: str
    count: int
    tightened: int
    force_p95: float


def firm_rows(firm: Sequence[ScenarioResult], names: Iterable[str]) -> list[FirmRow]:
    """Return a row of each of these controllers; empty without firm grasps."""
    return [
        FirmRow(
            name,
            len(firm),
            sum(one.outcomes[name].tightenings > 0 for one in firm),
            float(np.quantile([one.outcomes[name].force_n / one.scenario.grip_n for one in firm], 0.95)),
        )
        for name in (names if firm else ())
    ]


def disturbances(results: Iterable[ScenarioResult]) -> dict[str, dict[str, float | int]]:
    """Return what each disturbance of a held object did: drops, slip, and force after over before."""
    found: dict[str, list[tuple[bool, float, float]]] = {}
    for one in results:
        held_by_bound = {d.name for d in one.outcomes[BOUND].disturbed if not d.dropped}
        for done in one.slipguard.disturbed:
            avoidable = done.dropped and (done.name in held_by_bound or done.name not in DISTURBANCES)
            found.setdefault(done.name, []).append((avoidable, done.slip_deg, done.after_n / done.before_n))
    return {
        name: {
            "count": len(rows),
            "drops_beyond_bound": sum(dropped for dropped, _, _ in rows),
            "slip_p95_deg": round(float(np.quantile([deg for _, deg, _ in rows], 0.95)), 3),
            "tightened": sum(ratio > TIGHTENED for _, _, ratio in rows),
            "force_ratio_worst": round(max(ratio for _, _, ratio in rows), 3),
        }
        for name, rows in found.items()
    }


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
    return quantile([abs(a - b) / b for a, b in pairs], 0.5)


def quantile(values: Sequence[float], q: float) -> float | None:
    """Return a quantile rounded to three digits, q from 0 to 1; None without values."""
    return round(float(np.quantile(values, q)), 3) if values else None
