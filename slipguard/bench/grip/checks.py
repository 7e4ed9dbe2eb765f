"""The campaign's figures against what is promised of them: on the whole, on each gel alone, and beside the matrix."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

GROUPS = ("stiff", "soft", "high need", "fragile")
"""Looked at beside the whole; they are told, and fail nothing by themselves."""


@dataclass(frozen=True, slots=True)
class Bound:
    """One promise. key: of the figures. at_most or at_least: the one that is not None counts."""

    key: str
    title: str
    at_most: float | None = None
    at_least: float | None = None

    @property
    def allowed(self) -> str:
        """In words."""
        return f"≤ {self.at_most:g}" if self.at_most is not None else f"≥ {self.at_least:g}"

    def holds(self, value: float | None) -> bool:
        """True also of nothing: there was nothing to compare."""
        if value is None:
            return True
        above = self.at_most is not None and value > self.at_most
        return not above and not (self.at_least is not None and value < self.at_least)


BOUNDS = (
    Bound("drops_avoidable", "avoidable drops", at_most=0),
    Bound("turn_over_oracle_median", "slip / oracle's, median", at_most=1.25),
    Bound("turn_over_oracle_p95", "slip / oracle's, p95", at_most=1.6),
    Bound("fixed_step_turn_over_ours_median", "fixed step's / ours", at_least=1.2),
    Bound("fixed_step_turn_over_ours_at_0_97", "... gripped at 0.97", at_least=1.5),
    Bound("false_tightenings", "false, while held", at_most=0),
    Bound("force_over_needed_median", "peak force / needed", at_most=1.6),
    Bound("rendered_against_model", "rendered / model, apart", at_most=0.15),
    Bound("ended_without_need", "given up without need", at_most=0),
    Bound("holds_failed", "holds that failed", at_most=0),
)


@dataclass(frozen=True, slots=True)
class Check:
    """One promise and what was found: on the whole, and by group where it is known there."""

    bound: Bound
    value: float | None
    groups: dict[str, float | None]

    @property
    def held(self) -> bool:
        """On the whole."""
        return self.bound.holds(self.value)

    def as_json(self) -> dict[str, object]:
        """For a program."""
        return {
            "key": self.bound.key,
            "allowed": self.bound.allowed,
            "value": self.value,
            "held": self.held,
            "not_held_in": [group for group, value in self.groups.items() if not self.bound.holds(value)],
        }


def checks(figures: Mapping[str, Any]) -> list[Check]:
    """Every promise, by the figures of `as_json`."""
    parts: dict[str, Mapping[str, Any]] = {
        "stiff": figures["by_gel"].get("stiff") or {},
        "soft": figures["by_gel"].get("soft") or {},
        "high need": figures["high_need"] or {},
        "fragile": figures["fragile"] or {},
    }
    return [
        Check(bound, figures[bound.key], {group: parts[group].get(bound.key) for group in GROUPS}) for bound in BOUNDS
    ]


def failures(figures: Mapping[str, Any]) -> list[str]:
    """The promises that are not kept on the whole, one line each."""
    return [
        f"not held: {check.bound.title}: {check.value:g} ({check.bound.allowed})"
        for check in checks(figures)
        if not check.held
    ]


def remarks(figures: Mapping[str, Any]) -> list[str]:
    """Where a promise that is kept on the whole, or not made of a group, is not kept by the group alone."""
    return [
        f"{group} alone: {check.bound.title}: {check.groups[group]:g} ({check.bound.allowed})"
        for check in checks(figures)
        for group in GROUPS
        if not check.bound.holds(check.groups[group])
    ]
