"""Slides: mass is added on the grip axis of a held object, at textured and at plain contacts."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from slipguard.bench.grip.lift_course import GripOutcome
from slipguard.bench.grip.lift_run import PlantName, run_lift
from slipguard.bench.grip.scenarios import LIFT_M_S2, NEEDED_SHARE, PADS, GripScenario, draw
from slipguard.limit_surface import FINGER_COUNT, GRAVITY_M_S2

ADDED_KG = 0.6
HELD_KG = (0.3, 2.0)
FRICTION = (0.2, 0.5)
FIRST_GRIP = (1.02, 1.4)
"""First grip relative to the force that the object needs before mass is added."""
CONTACTS = {"textured": ("key", "cap", "bar"), "plain": ("screwdriver",)}
"""The end of the screwdriver's smooth shaft alone shows that it slides: half of the distance is missed, or more."""
REPORT_S = 0.1


@dataclass(frozen=True, slots=True)
class AddedMass:
    """One scenario with the outcomes of slipguard and of the reactive bound. contact: a key of `CONTACTS`."""

    contact: str
    scenario: GripScenario
    slipguard: GripOutcome
    reactive: GripOutcome


def added_mass_scenarios(count: int, seed: int) -> list[tuple[str, GripScenario]]:
    """Return contacts and scenarios, as many textured as plain ones. Equal seeds give equal scenarios."""
    kinds = tuple(CONTACTS)
    return [(kinds[k % len(kinds)], _drawn(kinds[k % len(kinds)], seed, k)) for k in range(count)]


def _drawn(contact: str, seed: int, number: int) -> GripScenario:
    """Return one scenario; draws are repeated until the first grip holds the object, but not the added mass."""
    rng = np.random.default_rng([seed, number, 31])
    plain = draw(seed, number, "mass added", "slide", PADS[number // len(CONTACTS) % len(PADS)])
    gripper = plain.pose.gripper
    while True:
        held_kg = float(rng.uniform(*HELD_KG))
        friction = math.exp(rng.uniform(*np.log(FRICTION)))
        holds = FINGER_COUNT * friction * gripper.gain
        needed_n = (held_kg + ADDED_KG) * GRAVITY_M_S2 / holds
        before_n = held_kg * (GRAVITY_M_S2 + LIFT_M_S2) / holds
        first_n = gripper.quantized_force_n(float(rng.uniform(*FIRST_GRIP)) * before_n)
        if first_n < needed_n <= NEEDED_SHARE[1] * plain.force_max_n:
            break
    return replace(
        plain,
        first_n=first_n,
        needed_n=gripper.gain * needed_n,
        mass_kg=held_kg + ADDED_KG,
        friction=friction,
        base_share=held_kg / (held_kg + ADDED_KG),
        pose=replace(plain.pose, object_name=str(rng.choice(CONTACTS[contact]))),
        outage=None,
    )


def run_added_mass(item: tuple[str, GripScenario], plant: PlantName) -> AddedMass:
    """Run a scenario with slipguard and with the reactive bound."""
    contact, scenario = item
    return AddedMass(
        contact, scenario, run_lift(scenario, "slipguard", plant), run_lift(scenario, "reactive", plant)
    )  # fmt: skip


def added_mass_figures(results: Sequence[AddedMass]) -> dict[str, dict[str, Any]]:
    """Return the figures by contact: what is held of what the reactive bound holds, and how fast slides are answered.

    Times count from the first slip and contain the camera's latency; `answer_over_bound_s_p95` is without it.
    """
    return {kind: _figures([one for one in results if one.contact == kind]) for kind in CONTACTS}


def lost_share(results: Sequence[AddedMass]) -> float | None:
    """Return the share that slipguard drops of what the reactive bound holds; None if it holds nothing."""
    possible = [one for one in results if one.reactive.dropped is None]
    return sum(one.slipguard.dropped is not None for one in possible) / len(possible) if possible else None


def _figures(results: Sequence[AddedMass]) -> dict[str, Any]:
    possible = [one for one in results if one.reactive.dropped is None]
    held = [one.slipguard for one in possible if one.slipguard.dropped is None]
    lost = [one.slipguard.answered_s for one in results if one.slipguard.dropped is not None]
    both = ((one.slipguard.answered_s, one.reactive.answered_s) for one in results)
    return {
        "scenarios": len(results),
        "bound_holds": len(possible),
        "held": len(held),
        "held_share": len(held) / len(possible) if possible else None,
        "slide_p95_mm": _p95([one.slipguard.slide_mm for one in possible]),
        "bound_slide_p95_mm": _p95([one.reactive.slide_mm for one in possible]),
        "answer_s_p95": _p95([one.slipguard.answered_s for one in results if one.slipguard.answered_s is not None]),
        "answer_over_bound_s_p95": _p95([ours - its for ours, its in both if ours is not None and its is not None]),
        "lost": len(lost),
        "lost_answered_in_0_1_s": sum(answered_s is not None and answered_s <= REPORT_S for answered_s in lost),
    }


def _p95(values: Sequence[float]) -> float | None:
    return round(float(np.quantile(values, 0.95)), 3) if values else None
