"""The scenarios of the grip bench: their range, their needed force, and their seeds."""

from __future__ import annotations

import math
from collections import Counter

import pytest

from slipguard.bench.grip.campaign import CampaignPlan
from slipguard.bench.grip.scenarios import (
    EVENTS,
    FIRST_TEST_SEED,
    LIFT_M_S2,
    LIMITS_N,
    MOTIONS,
    NEEDED_SHARE,
    PADS,
    GripScenario,
    scenarios,
)
from slipguard.limit_surface import GRAVITY_M_S2, force_needed_n

SOME = scenarios(180, 1000)


def share(one: GripScenario) -> float:
    return one.needed_n / (one.pose.gripper.gain * one.force_max_n)


def test_every_event_motion_and_pad_appears_equally_often() -> None:
    cells = Counter((one.event, one.motion, one.pad) for one in SOME)
    assert len(cells) == len(EVENTS) * len(MOTIONS) * len(PADS)
    assert set(cells.values()) == {4}
    assert {one.force_max_n for one in SOME} == set(LIMITS_N)


def test_the_needed_force_is_log_uniform_over_the_limit_so_no_constant_suits_all() -> None:
    shares = sorted(share(one) for one in SOME)
    assert NEEDED_SHARE[0] <= shares[0] < 0.1
    assert 0.75 < shares[-1] <= NEEDED_SHARE[1]
    assert shares[len(shares) // 2] == pytest.approx(math.sqrt(NEEDED_SHARE[0] * NEEDED_SHARE[1]), rel=0.3)


def test_friction_differs_between_fingers_and_stays_in_range() -> None:
    for one in SOME:
        fingers = [one.friction * (1.0 + sign * one.pose.friction_difference) for sign in (1.0, -1.0)]
        assert 0.2 <= min(fingers) <= max(fingers) <= 1.2 + 1e-9
    assert max(abs(one.pose.friction_difference) for one in SOME) > 0.2


def test_some_grasps_are_firm_some_weak_and_none_exceeds_its_limit() -> None:
    assert sum(one.firm for one in SOME) > 10
    assert sum(one.weak for one in SOME) > 30
    assert not any(one.firm and one.weak for one in SOME)
    for one in SOME:
        assert one.first_n <= one.force_max_n


@pytest.mark.parametrize("one", SOME[:20], ids=lambda one: one.event)
def test_the_largest_load_needs_the_stated_force(one: GripScenario) -> None:
    lifted = 1.0 + LIFT_M_S2 / GRAVITY_M_S2
    at_lift, later = {"lift": (lifted, 0.0), "support gone": (1.0, 0.0)}.get(one.event, (one.base_share * lifted, 1.0))
    load_n = 0.5 * max(at_lift, later) * one.mass_kg * GRAVITY_M_S2
    lever_m = 1e-3 * one.lever_mm * math.cos(math.radians(one.pose.lever_deg))
    assert force_needed_n(load_n, lever_m, one.friction, one.pose.gel) == pytest.approx(one.needed_n, rel=1e-6)
    assert one.item.mass_kg <= one.mass_kg


def test_equal_seeds_give_equal_scenarios_and_test_seeds_are_named() -> None:
    assert [one.as_json() for one in scenarios(5, 1000)] == [one.as_json() for one in SOME[:5]]
    assert [one.needed_n for one in scenarios(5, 4)] != [one.needed_n for one in SOME[:5]]
    assert CampaignPlan.of(quick=True, seed=0).seed_set == "tuning"
    assert CampaignPlan.of(quick=True, seed=FIRST_TEST_SEED, plant="mujoco").seed_set == "test"
    assert CampaignPlan.of(quick=True, plant="mujoco").scenarios == CampaignPlan.of(quick=True).scenarios
