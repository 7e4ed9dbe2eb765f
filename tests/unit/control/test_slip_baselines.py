"""The baselines from which slip counts: settled, resting, and as other fingers see them."""

from __future__ import annotations

import math

import pytest
from controller_steps import PARAMS
from observations import fused
from records import changed

from slipguard.control.finger_fusion import FusedEstimate
from slipguard.control.slip_baselines import Baselines
from slipguard.control.slip_memory import FOLLOW_S, STEADY_DEG_S, ArmCase, SlipMemory

SINCE_S, NOW_S = 5.0, 10.0
TOLERANCE_DEG = PARAMS.tuning.settle_deg
SETTLED = Baselines(settled_deg=3.0, settled_mm=0.5, settled_side_mm=-0.2, settled_since_s=SINCE_S)


def seen(rotation_deg: float | None = 3.0, shift_mm: float | None = 0.5, side_mm: float | None = -0.2) -> FusedEstimate:
    return changed(fused(rotation_deg, at_s=NOW_S, shift_mm=shift_mm, sigma_deg=0.3), sideways_mm=side_mm)


def test_other_fingers_see_every_baseline_with_their_offset() -> None:
    numbers = Baselines(1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0, 10.0, 11.0, (12.0, 13.0))
    expected = Baselines(1.5, 2.2, 3.5, 4.2, 5.0, 6.5, 7.5, 8.5, 8.9, 9.9, 11.5, (12.2, 12.9))
    for name in Baselines.__slots__:
        assert getattr(numbers.moved(0.5, 0.2, -0.1), name) == pytest.approx(getattr(expected, name)), name
    unknown = Baselines(unloaded_deg=None, unloaded_mm=None)
    assert unknown.moved(0.5, 0.2, -0.1) == unknown


def test_within_the_tolerance_the_object_stays_settled_where_it_was() -> None:
    assert SETTLED.with_settled(seen(3.2, 0.6, -0.1), PARAMS) == SETTLED


@pytest.mark.parametrize("there", [seen(3.1 + TOLERANCE_DEG), seen(shift_mm=0.9), seen(side_mm=0.2)])
def test_beyond_the_tolerance_it_settles_there(there: FusedEstimate) -> None:
    found = SETTLED.with_settled(there, PARAMS)
    assert (found.settled_deg, found.settled_mm) == (there.rotation_deg, there.shift_mm)
    assert (found.settled_side_mm, found.settled_since_s) == (there.sideways_mm, NOW_S)


@pytest.mark.parametrize(("sigmas", "stays"), [(None, False), (0.49, False), (0.51, True)])
def test_the_tolerance_is_two_sigma_if_that_is_more(sigmas: float | None, stays: bool) -> None:
    by_deg = 1.5 * TOLERANCE_DEG
    there = changed(seen(3.0 + by_deg), sigma_deg=None if sigmas is None else sigmas * by_deg)
    assert (SETTLED.with_settled(there, PARAMS).settled_since_s == SINCE_S) is stays


@pytest.mark.parametrize("name", ["settled_deg", "settled_mm", "settled_side_mm"])
def test_what_was_unknown_is_noted_as_soon_as_it_is_seen(name: str) -> None:
    assert changed(SETTLED, **{name: None}).with_settled(seen(), PARAMS) == SETTLED


# --- the resting angle ---


def followed(memory: SlipMemory, there: FusedEstimate, *, new_rest: bool = False) -> SlipMemory:
    return memory.followed(there, ArmCase.REST, new_rest=new_rest, params=PARAMS)


RESTS = changed(SlipMemory(), resting_deg=3.0, previous_deg=3.1, before_motion_deg=2.0, followed_s=NOW_S - 0.1)


def test_the_resting_angle_follows_slowly_and_so_does_the_one_before_the_motion() -> None:
    found = followed(RESTS, seen(3.2))
    drift_deg = 0.2 * (1.0 - math.exp(-0.1 / FOLLOW_S))
    assert found.baselines.resting_deg == pytest.approx(3.0 + drift_deg)
    assert found.baselines.before_motion_deg == pytest.approx(2.0 + drift_deg)
    assert (found.baselines.previous_deg, found.followed_s) == (3.2, NOW_S)


def test_far_from_the_resting_angle_nothing_follows() -> None:
    found = followed(RESTS, seen(30.0))
    assert (found.baselines.resting_deg, found.baselines.previous_deg, found.followed_s) == (3.0, None, NOW_S)
    assert found.noise_deg2 == RESTS.noise_deg2


def test_the_same_frame_counts_once() -> None:
    again = changed(RESTS, followed_s=NOW_S)
    assert followed(again, seen(3.2)) is again


@pytest.mark.parametrize(("rate_deg_s", "rests"), [(None, True), (STEADY_DEG_S, True), (1.1 * STEADY_DEG_S, False)])
def test_a_new_resting_angle_needs_an_object_that_is_steady(rate_deg_s: float | None, rests: bool) -> None:
    found = followed(RESTS, changed(seen(4.0), rate_deg_s=rate_deg_s), new_rest=True)
    assert found.baselines.resting_deg == (4.0 if rests else None)
    assert (found.baselines.previous_deg, found.followed_s) == (None, NOW_S)
