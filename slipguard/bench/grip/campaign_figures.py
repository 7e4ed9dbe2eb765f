"""Figures of a campaign as JSON, and their specified limits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from slipguard.bench.grip.campaign import GripCampaignResult, TrialOutcomes
from slipguard.bench.grip.group_statistics import (
    FLOOR_DEG,
    GELS,
    JSON_NAMES,
    SHOWN,
    by_first_grip,
    by_gel,
    median,
    of,
    of_gel,
    ratios,
    rounded,
    row,
)
from slipguard.bench.grip.stable_holds import HoldOutcome
from slipguard.bench.grip.trial_run import TrialOutcome
from slipguard.bench.grip.trials import SHARES

FINE_FLOOR_DEG = 0.1
"""A smaller floor for slip ratios: below it the oracle does not react."""


@dataclass(frozen=True, slots=True)
class ModelAgreement:
    """Mean final slip with rendered frames and with the error model on the same trials, and their difference."""

    count: int
    rendered_deg: float
    model_deg: float
    apart: float
    differs_deg: float


def agreement(played: Sequence[TrialOutcomes]) -> ModelAgreement | None:
    """Return the agreement; None without rendered trials. apart: of the means, relative; differs_deg: median."""
    pairs = [(one.rendered.slip_deg, one.outcomes["slipguard"].slip_deg) for one in played if one.rendered is not None]
    if not pairs:
        return None
    rendered, model = np.asarray(pairs).T
    mean = float(model.mean())
    apart = abs(float(rendered.mean()) - mean) / max(mean, FINE_FLOOR_DEG)
    return ModelAgreement(len(pairs), float(rendered.mean()), mean, apart, float(np.median(np.abs(rendered - model))))


def as_json(found: GripCampaignResult) -> dict[str, object]:
    """Return all figures. Ratios outside a group are of the whole matrix, stiff and soft gels together."""
    everything = row("all", found.trials)
    similar = agreement(found.trials)
    blocks = [found.trials, found.gone, found.high_need, found.fragile]
    fine = ratios(found.trials, "slipguard", "oracle", FINE_FLOOR_DEG)
    return {
        "scenarios": len(found.trials),
        "rendered": sum(one.rendered is not None for one in found.trials),
        "drops_avoidable": sum(row("", block).avoidable for block in blocks if block),
        "turn_over_oracle_median": rounded(everything.over_oracle),
        "turn_over_oracle_p95": rounded(everything.over_oracle_p95),
        "fixed_step_turn_over_ours_median": rounded(everything.fixed_over_slipguard),
        "false_tightenings": _false_while_holding(found.holds),
        "force_over_needed_median": rounded(everything.force_over_needed),
        "fixed_step_turn_over_ours_at_0_97": _at_weakest(found.trials),
        "rendered_against_model": rounded(similar.apart if similar is not None else None),
        "ended_without_need": sum(row("", block).ended for block in blocks if block),
        "holds_failed": sum(one.failed is not None for one in found.holds),
        "slip_floor_deg": FLOOR_DEG,
        "turn_over_oracle_median_floor_0_1": rounded(median(fine)),
        "turn_over_oracle_p95_floor_0_1": rounded(float(np.quantile(fine, 0.95)) if fine else None),
        "arrest_s_median": rounded(everything.arrested_s),
        "steps_median": everything.steps_median,
        "steps_max": everything.steps_max,
        "by_gel": {gel: _of_gel(found, gel) for gel in GELS if of_gel(found.trials, gel)},
        "by_first_grip": {one.title.removeprefix("grip "): one.as_json() for one in by_first_grip(found.trials)},
        "support_gone": _block(found.gone),
        "high_need": _block(found.high_need),
        "fragile": _block(found.fragile),
        "holds": holds_as_json(found.holds),
    }


def holds_as_json(held: Sequence[HoldOutcome]) -> dict[str, object]:
    """Return the figures of stable holds. false: a tightening without slip, during the hold or during its lift.

    False tightenings during the lift have no limit: while the far end lies on the table the rotation follows the lift,
    and no image separates elastic torsion from slip.
    """
    return {
        "count": len(held),
        "rendered": sum(one.hold.rendered for one in held),
        "minutes": round(sum(one.seconds for one in held) / 60.0, 1),
        "false_while_holding": _false_while_holding(held),
        "false_while_lifted": sum(one.false_lifting for one in held),
        "lifts_tightened": sum(one.lifting > 0 for one in held),
        "tightened_while_slipping": sum(one.tightenings + one.lifting - one.false for one in held),
    }


def _false_while_holding(held: Sequence[HoldOutcome]) -> int:
    return sum(one.false - one.false_lifting for one in held)


def scenarios(found: GripCampaignResult) -> dict[str, object]:
    played = [*found.trials, *found.gone, *found.high_need, *found.fragile]
    return {
        "trials": [_trial(one) for one in played],
        "stable_holds": [_hold(one) for one in found.holds],
    }


def _of_gel(found: GripCampaignResult, gel: str) -> dict[str, object]:
    """Return one gel's figures under the same keys as those of the whole."""
    played = of_gel(found.trials, gel)
    similar = agreement(played)
    held = [one for one in found.holds if one.hold.trial.soft is GELS[gel]]
    return row(gel, played).as_json() | {
        "fixed_step_turn_over_ours_at_0_97": _at_weakest(played),
        "rendered_against_model": rounded(similar.apart if similar is not None else None),
        "false_tightenings": _false_while_holding(held),
        "holds": holds_as_json(held),
        "by_first_grip": {one.title.removeprefix("grip "): one.as_json() for one in by_first_grip(played)},
    }


def _block(played: Sequence[TrialOutcomes]) -> dict[str, object] | None:
    if not played:
        return None
    gels = {one.title.removesuffix(" gel"): one.as_json() for one in by_gel(played)}
    return row("all", played).as_json() | {"by_gel": gels}


def _at_weakest(played: Sequence[TrialOutcomes]) -> float | None:
    """Return the fixed step's slip relative to slipguard's at the strongest first grip, where slip starts slowly."""
    return rounded(median(ratios([one for one in played if one.trial.share == SHARES[0]], "fixed step", "slipguard")))


def _trial(one: TrialOutcomes) -> dict[str, object]:
    trial = one.trial
    entry: dict[str, object] = {
        "number": trial.number,
        "block": trial.block,
        "event": trial.event,
        "object": trial.item.name,
        "first_grip": trial.share,
        "gel": "soft" if trial.soft else "stiff",
        "latency_s": trial.latency_s,
        "fps": trial.fps,
        "needed_n": round(trial.needed_n, 2),
        "force_max_n": trial.force_max_n,
        "gain": round(trial.scenario.gripper.gain, 3),
        "lift_speed_mm_s": round(trial.lift_speed_mm_s, 1),
    }
    entry |= {JSON_NAMES[name].replace(" ", "_"): _outcome(of(one, name)) for name in SHOWN}
    if one.rendered is not None:
        entry["law_with_error_model"] = _outcome(one.outcomes["slipguard"])
    return entry


def _outcome(outcome: TrialOutcome) -> dict[str, object]:
    return {
        "slip_deg": round(outcome.slip_deg, 3),
        "turn_deg": round(outcome.rotation_deg, 3),
        "force_over_needed": round(outcome.force_over_needed, 3),
        "arrest_s": rounded(outcome.arrested_s),
        "tightenings": outcome.tightenings,
        "before_any_slip": outcome.early,
        "dropped": outcome.dropped,
        "fault": outcome.fault,
        "up": outcome.up,
    }


def _hold(held: HoldOutcome) -> dict[str, object]:
    trial = held.hold.trial
    named = {"number": trial.number, "object": trial.item.name, "gel": "soft" if trial.soft else "stiff"}
    plan = {"rendered": held.hold.rendered, "margin": round(held.hold.margin, 3)}
    result = {key: value for key, value in asdict(held).items() if key not in ("hold", "elastic_deg", "messages")}
    return named | plan | result | {"wound_deg": held.elastic_deg, "said": held.messages}


GROUPS = ("stiff", "soft", "high need", "fragile")
"""Groups that are also compared with the limits; they are reported and do not fail the campaign."""


@dataclass(frozen=True, slots=True)
class FigureLimit:
    """The limit of one figure. key: in the JSON. Either at_most or at_least is set."""

    key: str
    title: str
    at_most: float | None = None
    at_least: float | None = None

    @property
    def allowed(self) -> str:
        return f"≤ {self.at_most:g}" if self.at_most is not None else f"≥ {self.at_least:g}"

    def holds(self, value: float | None) -> bool:
        """Return whether a value is within the limit; True for None."""
        if value is None:
            return True
        above = self.at_most is not None and value > self.at_most
        return not above and not (self.at_least is not None and value < self.at_least)


BOUNDS = (
    FigureLimit("drops_avoidable", "avoidable drops", at_most=0),
    FigureLimit("turn_over_oracle_median", "slip / oracle's slip, median", at_most=1.25),
    FigureLimit("turn_over_oracle_p95", "slip / oracle's slip, p95", at_most=1.6),
    FigureLimit("fixed_step_turn_over_ours_median", "fixed step's slip / slip", at_least=1.2),
    FigureLimit("fixed_step_turn_over_ours_at_0_97", "... first grip 0.97", at_least=1.5),
    FigureLimit("false_tightenings", "false tightenings", at_most=0),
    FigureLimit("force_over_needed_median", "peak force / needed", at_most=1.6),
    FigureLimit("rendered_against_model", "rendered vs. model", at_most=0.15),
    FigureLimit("ended_without_need", "avoidable stops", at_most=0),
    FigureLimit("holds_failed", "failed holds", at_most=0),
)


@dataclass(frozen=True, slots=True)
class LimitCheck:
    """One limit with the value of all trials and of each group."""

    bound: FigureLimit
    value: float | None
    groups: dict[str, float | None]

    @property
    def held(self) -> bool:
        """Whether the value of all trials is within the limit."""
        return self.bound.holds(self.value)

    def as_json(self) -> dict[str, object]:
        return {
            "key": self.bound.key,
            "allowed": self.bound.allowed,
            "value": self.value,
            "held": self.held,
            "not_held_in": [group for group, value in self.groups.items() if not self.bound.holds(value)],
        }


def checks(figures: Mapping[str, Any]) -> list[LimitCheck]:
    parts: dict[str, Mapping[str, Any]] = {
        "stiff": figures["by_gel"].get("stiff") or {},
        "soft": figures["by_gel"].get("soft") or {},
        "high need": figures["high_need"] or {},
        "fragile": figures["fragile"] or {},
    }
    return [
        LimitCheck(bound, figures[bound.key], {group: parts[group].get(bound.key) for group in GROUPS})
        for bound in BOUNDS
    ]


def failures(figures: Mapping[str, Any]) -> list[str]:
    """Return one line for each limit that is exceeded by all trials together."""
    return [
        f"limit exceeded: {check.bound.title} {check.value:g}, the limit is {check.bound.allowed}"
        for check in checks(figures)
        if not check.held
    ]


def remarks(figures: Mapping[str, Any]) -> list[str]:
    """Return one line for each limit that a single group exceeds."""
    return [
        f"{group} only: {check.bound.title} {check.groups[group]:g}, the limit is {check.bound.allowed}"
        for check in checks(figures)
        for group in GROUPS
        if not check.bound.holds(check.groups[group])
    ]
