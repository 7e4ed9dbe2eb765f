"""Mass that is added on the grip axis of a held object: scenarios and figures."""

from __future__ import annotations

from dataclasses import replace

import pytest

from slipguard.bench.grip.added_mass import (
    ADDED_KG,
    CONTACTS,
    AddedMass,
    added_mass_figures,
    added_mass_scenarios,
    lost_share,
    run_added_mass,
)
from slipguard.bench.grip.lift_course import GripOutcome
from slipguard.bench.grip.scenarios import GripScenario
from slipguard.limit_surface import GRAVITY_M_S2

SOME = added_mass_scenarios(24, 0)


def outcome(slide_mm: float = 3.0, answered_s: float | None = 0.08, dropped: str | None = None) -> GripOutcome:
    return GripOutcome(
        "slipguard", 0.0, slide_mm, 30.0, 25.0, 0.1, 1, 0, False, dropped, None, up=True, answered_s=answered_s
    )


def result(ours: GripOutcome, bound: GripOutcome, contact: str = "textured") -> AddedMass:
    return AddedMass(contact, SOME[0][1], ours, bound)


def test_the_first_grip_holds_the_object_and_not_the_added_mass() -> None:
    for contact, one in SOME:
        friction = 2.0 * one.friction / GRAVITY_M_S2
        assert (1.0 - one.base_share) * one.mass_kg == pytest.approx(ADDED_KG)
        assert one.mass_kg == pytest.approx(friction * one.needed_n, rel=1e-6)
        assert one.base_needed_n <= one.grip_n < one.needed_n <= one.pose.gripper.gain * one.force_max_n
        assert one.pose.object_name in CONTACTS[contact]
        assert one.lever_mm == 0.0
    assert [contact for contact, _ in SOME[:2]] == list(CONTACTS)
    assert added_mass_scenarios(2, 0) == SOME[:2]


def test_what_the_bound_drops_is_no_failure_and_its_answer_is_timed() -> None:
    lost = outcome(12.0, 0.12, "contact lost")
    results = [result(outcome(), outcome(2.0, 0.05)), result(lost, outcome(12.0, 0.06, "contact lost"))]
    found = added_mass_figures(results)
    textured = found["textured"]
    assert (textured["scenarios"], textured["bound_holds"], textured["held_share"]) == (2, 1, 1.0)
    assert (textured["slide_p95_mm"], textured["bound_slide_p95_mm"]) == (3.0, 2.0)
    assert (textured["lost"], textured["lost_answered_in_0_1_s"]) == (1, 0)
    assert textured["answer_over_bound_s_p95"] == pytest.approx(0.06, abs=0.002)
    assert (found["plain"]["held_share"], lost_share(results)) == (None, 0.0)
    assert lost_share([result(lost, outcome())]) == 1.0
    assert lost_share([]) is None


def test_added_mass_slides_and_is_answered() -> None:
    contact, one = next((c, s) for c, s in SOME if 0.85 < s.grip_n / s.needed_n < 0.95 and s.pad == "stiff")
    found = run_added_mass((contact, slow(one)), "own")
    assert found.slipguard.answered_s is not None
    assert 0.02 < found.slipguard.answered_s < 0.3
    assert found.reactive.slide_mm <= found.slipguard.slide_mm


def slow(one: GripScenario) -> GripScenario:
    return replace(one, lift_speed_mm_s=60.0)
