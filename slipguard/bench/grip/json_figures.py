"""The figures of a campaign as JSON, and their limits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from slipguard.bench.grip import figures
from slipguard.bench.grip.campaign import (
    BOUND,
    FIXED_STEP,
    REACTING,
    REACTIVE,
    GripCampaignResult,
    ScenarioResult,
)
from slipguard.bench.grip.disturbances import DISTURBANCES, LASTS_S
from slipguard.bench.grip.figures import quantile, ratios
from slipguard.bench.grip.lift_course import GripOutcome
from slipguard.bench.grip.scenarios import PADS

FIRST_GRIPS = {"0.30-0.50": (0.0, 0.5), "0.50-0.75": (0.5, 0.75), "0.75-0.90": (0.75, 0.9), "0.90-0.97": (0.9, 1.0)}
"""First grip over needed force."""
HIGH_NEED, FRAGILE_MAX_N = 0.75, 60.0


def as_json(found: GripCampaignResult) -> dict[str, Any]:
    """Return all figures. Slips and forces are of the weak lifts that the actuator can answer."""
    weak, firm, rows = found.weak, found.firm, figures.pareto_rows(found.weak)
    tightened = {row.controller: row.tightened for row in figures.firm_rows(firm, REACTING)}
    held = [one for one in firm if one.slipguard.disturbed]
    while_held = sum(one.slipguard.held for one in held)
    near = [one for one in weak if _grip(one) > FIRST_GRIPS["0.90-0.97"][0]]
    fine = ratios(weak, "slipguard", BOUND, figures.FINE_FLOOR_DEG)
    ours = rows[0].as_json() if rows else {}
    mass = [one for one in weak if one.scenario.event == "mass added"]
    lost = sum(one.slipguard.dropped is not None for one in mass)
    return {
        "plant": found.plan.plant,
        "seed": found.plan.seed,
        "seed_set": found.plan.seed_set,
        "scenarios": len(found.results),
        "weak": len(weak),
        "beyond_actuator": _beyond(found.beyond_actuator),
        "physical_bound": _physical_bound(found),
        "added_mass": _of(mass),
        "added_mass_lost_share": round(lost / len(mass), 3) if mass else None,
        "rendered": sum(one.rendered is not None for one in found.results),
        "drops_avoidable": figures.drops_beyond_bound(found.results),
        "drops_beyond_bound": figures.drops_beyond_bound(found.results),
        **{name: ours.get(name) for name in ("slip_median_deg", "slip_p95_deg", "slip_worst_deg")},
        **{name: ours.get(name) for name in ("slide_p95_mm", "slide_worst_mm")},
        **{name: ours.get(name) for name in ("force_over_needed_median", "force_over_needed_p95")},
        "dominated_by": figures.dominated_by(rows),
        "naive_at_equal_force": figures.naive_at_equal_force(rows),
        "firm": len(firm),
        "firm_tightened_share": round(tightened["slipguard"] / len(firm), 3) if firm else None,
        "firm_tightened_while_held_share": (
            round(sum(one.slipguard.held > 0 for one in held) / len(held), 3) if held else None
        ),
        "false_tightenings": tightened.get("slipguard", 0) + while_held,
        "disturbances": figures.disturbances(found.results),
        "turn_over_oracle_median": quantile(ratios(weak, "slipguard", BOUND), 0.5),
        "turn_over_oracle_p95": quantile(ratios(weak, "slipguard", BOUND), 0.95),
        "fixed_step_turn_over_ours_median": quantile(ratios(weak, FIXED_STEP, "slipguard"), 0.5),
        "fixed_step_turn_over_ours_at_0_97": quantile(ratios(near, FIXED_STEP, "slipguard"), 0.5),
        "rendered_against_model": figures.rendered_difference(found.results),
        "ended_without_need": figures.ended_without_need(found.results),
        "holds_failed": sum(one.slipguard.dropped is not None or one.slipguard.fault is not None for one in firm),
        "slip_floor_deg": figures.FLOOR_DEG,
        "turn_over_oracle_median_floor_0_1": quantile(fine, 0.5),
        "turn_over_oracle_p95_floor_0_1": quantile(fine, 0.95),
        "arrest_s_median": _of(weak)["arrest_s_median"],
        **_onset_to_command(weak),
        "steps_median": _of(weak)["steps_median"],
        "steps_max": max((one.slipguard.tightenings for one in weak), default=0),
        "controllers": [row.as_json() for row in rows],
        "groups": {name: _of(part) for name, part in figures.groups(found).items()},
        "by_gel": {kind: _of([one for one in weak if one.scenario.pad == kind]) for kind in PADS},
        "by_first_grip": {
            name: _of([one for one in weak if low <= _grip(one) < high]) for name, (low, high) in FIRST_GRIPS.items()
        },
        "support_gone": _of([one for one in weak if one.scenario.event == "support gone"]),
        "high_need": _of([one for one in weak if one.scenario.needed_n > HIGH_NEED * one.scenario.force_max_n]),
        "fragile": _of([one for one in weak if one.scenario.force_max_n <= FRAGILE_MAX_N]),
        "holds": {
            "count": len(firm),
            "minutes": round(len(held) * len(DISTURBANCES) * LASTS_S / 60.0, 2),
            "false_while_lifted": tightened.get("slipguard", 0),
            "false_while_holding": while_held,
            "tightened_while_slipping": sum(_tightened_after_slip(one.slipguard) for one in firm),
            "lifts_tightened": tightened,
        },
    }


def _grip(one: ScenarioResult) -> float:
    """Return the first grip over the needed force."""
    return one.scenario.grip_n / one.scenario.needed_n


def _tightened_after_slip(outcome: GripOutcome) -> bool:
    return outcome.tightenings + outcome.held > 0 and not outcome.early


def _onset_to_command(results: Sequence[ScenarioResult]) -> dict[str, float | None]:
    """Return the time from the first slip to the next command; 0 where the grip was tightened before any slip."""
    ours = [0.0 if one.slipguard.early else one.slipguard.answered_s for one in results]
    known_s = [time_s for time_s in ours if time_s is not None]
    return {
        "onset_to_command_s_median": quantile(known_s, 0.5),
        "onset_to_command_s_p95": quantile(known_s, 0.95),
    }


def _beyond(results: Sequence[ScenarioResult]) -> dict[str, Any]:
    """Return the figures of the lifts whose load arrives faster than the gripper tightens."""
    excess = figures.excess_over_bound(results)
    return {
        "scenarios": len(results),
        "drops": sum(one.slipguard.dropped is not None for one in results),
        "drops_of_bound": sum(not one.holdable for one in results),
        "slip_over_bound_median_deg": quantile([deg for deg, _ in excess], 0.5),
        "slide_over_bound_median_mm": quantile([mm for _, mm in excess], 0.5),
    }


def _physical_bound(found: GripCampaignResult) -> dict[str, Any]:
    """Return the figures of all weak lifts against the reactive bound, and of those that this bound holds."""
    excess = figures.excess_over_bound((one for one in found.results if one.scenario.weak), REACTIVE)
    rows = figures.pareto_rows(found.avoidable)
    return {
        "weak": len(excess),
        "slip_over_reactive_p95_deg": quantile([deg for deg, _ in excess], 0.95),
        "slide_over_reactive_p95_mm": quantile([mm for _, mm in excess], 0.95),
        "avoidable": len(found.avoidable),
        "dominated_by": figures.dominated_by(rows),
        "controllers": [row.as_json() for row in rows],
    }


def _of(results: Sequence[ScenarioResult]) -> dict[str, Any]:
    """Return the figures of a group of weak lifts; None where it is empty."""
    ours = [one.slipguard for one in results]
    row = figures.ControllerRow.of("slipguard", ours).as_json() if ours else {}
    shown = ("force_over_needed_median", "slip_p95_deg", "slip_worst_deg", "drops")
    return {
        "scenarios": len(results),
        **{name: row.get(name) for name in shown},
        "turn_over_oracle_median": quantile(ratios(results, "slipguard", BOUND), 0.5),
        "fixed_step_turn_over_ours_median": quantile(ratios(results, FIXED_STEP, "slipguard"), 0.5),
        "arrest_s_median": quantile([one.arrested_s for one in ours if one.arrested_s is not None], 0.5),
        "steps_median": quantile([float(one.tightenings) for one in ours], 0.5),
    }


def scenarios_as_json(found: GripCampaignResult) -> dict[str, object]:
    """Return every scenario with the outcomes of its controllers."""
    return {
        "trials": [
            one.scenario.as_json()
            | {name.replace(" ", "_"): _outcome(outcome) for name, outcome in one.outcomes.items()}
            | ({} if one.rendered is None else {"slipguard_rendered": _outcome(one.rendered)})
            for one in found.results
        ]
    }


def _outcome(outcome: GripOutcome) -> dict[str, object]:
    return {
        "slip_deg": round(outcome.slip_deg, 3),
        "slide_mm": round(outcome.slide_mm, 3),
        "force_over_needed": round(outcome.force_over_needed, 3),
        "arrest_s": None if outcome.arrested_s is None else round(outcome.arrested_s, 3),
        "tightenings": outcome.tightenings,
        "tightenings_held": outcome.held,
        "before_any_slip": outcome.early,
        "dropped": outcome.dropped,
        "fault": outcome.fault,
        "up": outcome.up,
        **({"messages": outcome.messages} if outcome.controller == "slipguard" else {}),
    }


@dataclass(frozen=True, slots=True)
class FigureLimit:
    """The limit of one figure. key: in the JSON."""

    key: str
    title: str
    at_most: float

    def holds(self, value: float | None) -> bool:
        """Return whether a value is within the limit; True for None."""
        return value is None or value <= self.at_most


LIMITS = (
    FigureLimit("slip_median_deg", "final slip in degrees, median", 1.0),
    FigureLimit("slip_p95_deg", "final slip in degrees, p95", 4.0),
    FigureLimit("slip_worst_deg", "final slip in degrees, worst", 10.0),
    FigureLimit("force_over_needed_median", "force over needed, median", 1.45),
    FigureLimit("force_over_needed_p95", "force over needed, p95", 2.2),
    FigureLimit("drops_beyond_bound", "drops that the clairvoyant bound would not have", 0),
    FigureLimit("naive_ratio", "slip p95 over the naive law's at equal force", 0.5),
    FigureLimit("dominated_by", "baselines that are better in slip and force", 0),
    FigureLimit("onset_to_command_s_median", "seconds from the first slip to a command, median", 0.085),
    FigureLimit("onset_to_command_s_p95", "seconds from the first slip to a command, p95", 0.11),
    FigureLimit("firm_tightened_share", "share of firm grasps tightened during the lift", 0.05),
    FigureLimit("false_while_holding", "tightenings of firm grasps while held", 0),
    FigureLimit("dropped_by_disturbance", "held objects dropped by a disturbance", 0),
    FigureLimit("vibration_force_ratio", "force after vibration over before, worst", 1.2),
    FigureLimit("lowering_force_ratio", "force after lowering over before, worst", figures.TIGHTENED),
    FigureLimit("ended_without_need", "avoidable stops", 0),
    FigureLimit("holds_failed", "failed holds of firm grasps", 0),
    FigureLimit("rendered_against_model", "force with rendered frames against the model", 0.15),
)


@dataclass(frozen=True, slots=True)
class LimitCheck:
    """One limit with its value. by_group: the same figure of groups of lifts, where it is known."""

    limit: FigureLimit
    value: float | None
    by_group: Mapping[str, float | None] = field(default_factory=dict)

    @property
    def kept(self) -> bool:
        return self.limit.holds(self.value)

    def as_json(self) -> dict[str, object]:
        return {
            "key": self.limit.key,
            "allowed": f"≤ {self.limit.at_most:g}",
            "value": self.value,
            "held": self.kept,
            "not_held_in": [name for name, value in self.by_group.items() if not self.limit.holds(value)],
        }


def checks(found: Mapping[str, Any]) -> list[LimitCheck]:
    """Return every limit with its value, on the whole and by pads, high need and fragile objects."""
    disturbed: Mapping[str, Any] = found["disturbances"]
    values = {
        **found,
        **found["holds"],
        "dominated_by": len(found["dominated_by"]),
        "naive_ratio": (found["naive_at_equal_force"] or {}).get("ratio"),
        "dropped_by_disturbance": sum(one["drops_beyond_bound"] for one in disturbed.values()),
        "vibration_force_ratio": _worst(disturbed, "vibration"),
        "lowering_force_ratio": _worst(disturbed, "lowering"),
    }
    groups = {**found["by_gel"], "high need": found["high_need"], "fragile": found["fragile"]}
    return [
        LimitCheck(limit, values[limit.key], {name: part.get(limit.key) for name, part in groups.items()})
        for limit in LIMITS
    ]


def _worst(disturbed: Mapping[str, Any], name: str) -> float | None:
    return max((one["force_ratio_worst"] for key, one in disturbed.items() if key.startswith(name)), default=None)


def failures(found: Mapping[str, Any]) -> list[str]:
    """Return a line for each limit that is exceeded."""
    return [
        f"limit exceeded on the plant {found['plant']}: {check.limit.title}: {check.value:g}, "
        f"limit {check.limit.at_most:g}"
        for check in checks(found)
        if not check.kept and check.value is not None
    ]
