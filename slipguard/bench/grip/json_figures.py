"""The figures of a campaign as JSON, and their limits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from slipguard.bench.grip import figures
from slipguard.bench.grip.added_mass import added_mass_figures, lost_share
from slipguard.bench.grip.campaign import REACTING, REACTIVE, GripCampaignResult, ScenarioResult
from slipguard.bench.grip.lift_course import GripOutcome
from slipguard.bench.grip.scenarios import PADS

FIRST_GRIPS = {"0.30-0.50": (0.0, 0.5), "0.50-0.75": (0.5, 0.75), "0.75-0.90": (0.75, 0.9), "0.90-0.97": (0.9, 1.0)}
"""First grip over needed force."""
HIGH_NEED, FRAGILE_MAX_N = 0.75, 60.0


def as_json(found: GripCampaignResult) -> dict[str, object]:
    """Return all figures. Slips and forces are of the weak lifts that the actuator can answer."""
    weak, rows = found.weak, figures.pareto_rows(found.weak)
    firm = {row.controller: row for row in figures.firm_rows(found.firm, REACTING)}
    ours = firm.get("slipguard")
    everything = _of(weak)
    fine = figures.ratios(weak, "slipguard", "clairvoyant", figures.FINE_FLOOR_DEG)
    near = [one for one in weak if one.scenario.grip_n > FIRST_GRIPS["0.90-0.97"][0] * one.scenario.needed_n]
    slipguard = rows[0].as_json() if rows else {}
    return {
        "plant": found.plan.plant,
        "seed": found.plan.seed,
        "seed_set": found.plan.seed_set,
        "scenarios": len(found.results),
        "weak": len(weak),
        "beyond_actuator": _beyond(found.beyond_actuator),
        "physical_bound": _physical_bound(found),
        "added_mass": added_mass_figures(found.added_mass),
        "added_mass_lost_share": _rounded(lost_share(found.added_mass)),
        "rendered": sum(one.rendered is not None for one in found.results),
        "drops_avoidable": figures.drops_beyond_bound(found.results),
        "drops_beyond_bound": figures.drops_beyond_bound(found.results),
        "force_over_needed_median": everything["force_over_needed_median"],
        **{name: slipguard.get(name) for name in ("force_over_needed_p95", "slip_p95_deg", "slip_worst_deg")},
        **{name: slipguard.get(name) for name in ("slide_p95_mm", "slide_worst_mm")},
        "dominated_by": figures.dominated_by(rows),
        "firm": len(found.firm),
        "firm_tightened_share": _rounded(None if ours is None else ours.tightened_share),
        "firm_tightened_while_held_share": _rounded(None if ours is None else ours.tightened_while_held_share),
        "false_tightenings": 0 if ours is None else ours.lifting + ours.held,
        "turn_over_oracle_median": everything["turn_over_oracle_median"],
        "turn_over_oracle_p95": _rounded(figures.quantile(figures.ratios(weak, "slipguard", "clairvoyant"), 0.95)),
        "fixed_step_turn_over_ours_median": everything["fixed_step_turn_over_ours_median"],
        "fixed_step_turn_over_ours_at_0_97": _rounded(figures.median(figures.ratios(near, "fixed step", "slipguard"))),
        "rendered_against_model": _rounded(figures.rendered_difference(found.results)),
        "ended_without_need": figures.ended_without_need(found.results),
        "holds_failed": sum(one.slipguard.dropped is not None or one.slipguard.fault is not None for one in found.firm),
        "slip_floor_deg": figures.FLOOR_DEG,
        "turn_over_oracle_median_floor_0_1": _rounded(figures.median(fine)),
        "turn_over_oracle_p95_floor_0_1": _rounded(figures.quantile(fine, 0.95)),
        "arrest_s_median": everything["arrest_s_median"],
        **_onset_to_command(weak),
        "steps_median": everything["steps_median"],
        "steps_max": max((one.slipguard.tightenings for one in weak), default=0),
        "controllers": [row.as_json() for row in rows],
        "groups": {name: _of(part) for name, part in figures.groups(found).items()},
        "by_gel": {kind: _of([one for one in weak if one.scenario.pad == kind]) for kind in PADS},
        "by_first_grip": {
            name: _of([one for one in weak if low <= one.scenario.grip_n / one.scenario.needed_n < high])
            for name, (low, high) in FIRST_GRIPS.items()
        },
        "support_gone": _of([one for one in weak if one.scenario.event == "support gone"]),
        "high_need": _of([one for one in weak if one.scenario.needed_n > HIGH_NEED * one.scenario.force_max_n]),
        "fragile": _of([one for one in weak if one.scenario.force_max_n <= FRAGILE_MAX_N]),
        "holds": {
            "count": len(found.firm),
            "minutes": round(len(found.firm) * found.plan.hold_s / 60.0, 2),
            "false_while_lifted": 0 if ours is None else ours.lifting,
            "false_while_holding": 0 if ours is None else ours.held,
            "tightened_while_slipping": sum(_tightened_after_slip(one.slipguard) for one in found.firm),
            "lifts_tightened": {name: row.lifting for name, row in firm.items()},
        },
    }  # fmt: skip


def _onset_to_command(results: Sequence[ScenarioResult]) -> dict[str, float | None]:
    """Return the time from the first slip to the next command; 0 where the grip was tightened before any slip."""
    ours = [one.slipguard for one in results]
    times_s = [0.0 if one.early else one.answered_s for one in ours if one.early or one.answered_s is not None]
    known_s = [time_s for time_s in times_s if time_s is not None]
    return {
        "onset_to_command_s_median": _rounded(figures.median(known_s)),
        "onset_to_command_s_p95": _rounded(figures.quantile(known_s, 0.95)),
    }


def _beyond(results: Sequence[ScenarioResult]) -> dict[str, Any]:
    """Return the figures of the lifts whose load arrives faster than the gripper tightens."""
    excess = figures.excess_over_bound(results)
    return {
        "scenarios": len(results),
        "drops": sum(one.slipguard.dropped is not None for one in results),
        "drops_of_bound": sum(not one.holdable for one in results),
        "slip_over_bound_median_deg": _rounded(figures.median([deg for deg, _ in excess])),
        "slide_over_bound_median_mm": _rounded(figures.median([mm for _, mm in excess])),
    }


def _physical_bound(found: GripCampaignResult) -> dict[str, Any]:
    """Return the figures of all weak lifts against the reactive bound, and of those that this bound holds."""
    excess = figures.excess_over_bound((one for one in found.results if one.scenario.weak), REACTIVE)
    rows = figures.pareto_rows(found.avoidable)
    return {
        "weak": len(excess),
        "slip_over_reactive_p95_deg": _rounded(figures.quantile([deg for deg, _ in excess], 0.95)),
        "slide_over_reactive_p95_mm": _rounded(figures.quantile([mm for _, mm in excess], 0.95)),
        "avoidable": len(found.avoidable),
        "dominated_by": figures.dominated_by(rows),
        "controllers": [row.as_json() for row in rows],
    }


def _of(results: Sequence[ScenarioResult]) -> dict[str, Any]:
    """Return the figures of a group of weak lifts; None where it is empty."""
    if not results:
        return {"scenarios": 0} | dict.fromkeys(
            (
                "force_over_needed_median", "slip_p95_deg", "slip_worst_deg", "drops", "turn_over_oracle_median",
                "fixed_step_turn_over_ours_median", "arrest_s_median", "steps_median",
            )
        )  # fmt: skip
    row = figures.ControllerRow.of("slipguard", [one.slipguard for one in results])
    arrests = [one.slipguard.arrested_s for one in results if one.slipguard.arrested_s is not None]
    return {
        "scenarios": len(results),
        "force_over_needed_median": _rounded(row.force_median),
        "slip_p95_deg": _rounded(row.slip_p95_deg),
        "slip_worst_deg": _rounded(row.slip_worst_deg),
        "drops": row.drops,
        "turn_over_oracle_median": _rounded(figures.median(figures.ratios(results, "slipguard", "clairvoyant"))),
        "fixed_step_turn_over_ours_median": _rounded(
            figures.median(figures.ratios(results, "fixed step", "slipguard"))
        ),
        "arrest_s_median": _rounded(figures.median(arrests)),
        "steps_median": figures.median([float(one.slipguard.tightenings) for one in results]),
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
        "arrest_s": _rounded(outcome.arrested_s),
        "tightenings": outcome.tightenings,
        "tightenings_held": outcome.held,
        "before_any_slip": outcome.early,
        "dropped": outcome.dropped,
        "fault": outcome.fault,
        "up": outcome.up,
        **({"messages": outcome.messages} if outcome.controller == "slipguard" else {}),
    }


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 3)


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
    FigureLimit("force_over_needed_median", "force over needed, median", 1.45),
    FigureLimit("force_over_needed_p95", "force over needed, p95", 2.2),
    FigureLimit("slip_p95_deg", "final slip in degrees, p95", 4.0),
    FigureLimit("slip_worst_deg", "final slip in degrees, worst", 10.0),
    FigureLimit("drops_beyond_bound", "drops that the clairvoyant bound would not have", 0),
    FigureLimit("onset_to_command_s_median", "seconds from the first slip to a command, median", 0.085),
    FigureLimit("onset_to_command_s_p95", "seconds from the first slip to a command, p95", 0.11),
    FigureLimit("firm_tightened_share", "share of firm grasps tightened during the lift", 0.05),
    FigureLimit("added_mass_lost_share", "share of added masses dropped without need", 0.05),
    FigureLimit("false_while_holding", "tightenings of firm grasps while held", 0),
    FigureLimit("dominated_by", "baselines that are better in slip and force", 0),
    FigureLimit("ended_without_need", "avoidable stops", 0),
    FigureLimit("holds_failed", "failed holds of firm grasps", 0),
    FigureLimit("rendered_against_model", "force with rendered frames against the error model", 0.15),
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


def _tightened_after_slip(outcome: GripOutcome) -> bool:
    return outcome.tightenings + outcome.held > 0 and not outcome.early


def checks(found: Mapping[str, Any]) -> list[LimitCheck]:
    """Return every limit with its value, on the whole and by pads, high need and fragile objects."""
    values = {**found, **found["holds"], "dominated_by": len(found["dominated_by"])}
    groups = {**found["by_gel"], "high need": found["high_need"], "fragile": found["fragile"]}
    return [
        LimitCheck(limit, values[limit.key], {name: part.get(limit.key) for name, part in groups.items()})
        for limit in LIMITS
    ]


def failures(found: Mapping[str, Any]) -> list[str]:
    """Return a line for each limit that is exceeded."""
    return [
        f"limit exceeded: {check.limit.title}: {check.value:g}, limit {check.limit.at_most:g}"
        for check in checks(found)
        if not check.kept and check.value is not None
    ]
