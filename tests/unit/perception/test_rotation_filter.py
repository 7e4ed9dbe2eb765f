"""The filter weighs the rotations that registrations find by the motion that is possible since the last frame."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from slipguard.perception.estimate import DeclineReason, RotationEstimate
from slipguard.perception.rotation_filter import (
    ACCELERATION_DEG_S2,
    RATE_STALE_S,
    Hypothesis,
    RotationFilter,
)

FRAME_S = 1.0 / 60.0


def followed(*seen: tuple[float, float]) -> RotationFilter:
    """Return a filter that has seen these times and rotations, from 0 at time 0."""
    rotations = RotationFilter()
    rotations.start(0.0)
    for at_s, rotation_deg in seen:
        rotations.update(at_s, [Hypothesis(rotation_deg, 0.0)])
    return rotations


def update(rotations: RotationFilter, at_s: float, *found: tuple[float, float]) -> RotationEstimate:
    """Update with rotations and their log likelihoods."""
    return rotations.update(at_s, [Hypothesis(*one) for one in found])


def test_from_rest_the_reach_is_that_of_the_largest_acceleration() -> None:
    rotations = followed()
    for gap_s in (0.01, 0.03, 0.1):
        assert rotations.reach_deg(gap_s) == pytest.approx(0.5 * ACCELERATION_DEG_S2 * gap_s**2)
    assert rotations.reach_deg(10.0) == 180.0
    assert rotations.reach_deg(-1.0) == 0.0


def test_a_moving_object_is_predicted_and_may_have_stopped() -> None:
    rotations = followed(*((k * FRAME_S, 4.0 * k) for k in range(1, 7)))
    assert rotations.predicted_deg(7 * FRAME_S) == pytest.approx(28.0)
    assert rotations.reach_deg(7 * FRAME_S) > 3.9
    assert update(rotations, 7 * FRAME_S, (28.0, 0.0), (0.0, 0.0)).rotation_deg == 28.0
    stopped = followed(*((k * FRAME_S, 4.0 * k) for k in range(1, 7)))
    assert update(stopped, 7 * FRAME_S, (24.0, 0.0)).rotation_deg == 24.0


@given(st.floats(0.001, 0.2), st.floats(1.0, 60.0), st.floats(20.0, 120.0))
def test_of_two_rotations_the_farther_one_never_wins(gap_s: float, near_deg: float, further_deg: float) -> None:
    found = update(followed(), gap_s, (near_deg, 0.0), (near_deg + further_deg, 0.0))
    assert found.rotation_deg in (None, near_deg)


def test_of_equal_likelihoods_the_credible_motion_counts() -> None:
    assert update(followed(), FRAME_S, (60.0, 0.0), (0.5, 0.0), (-60.0, 0.0)).rotation_deg == 0.5


def test_equally_credible_rotations_are_declined_together() -> None:
    rotations = followed()
    gap = update(rotations, 2.0, (10.0, 0.0), (70.0, 0.0), (-50.0, 0.0))
    assert gap.rotation_deg is None
    assert gap.declined is not None
    assert gap.declined.startswith(DeclineReason.SEVERAL_ROTATIONS)
    assert sorted(rotations.others_deg) == pytest.approx([-60.0, 60.0], abs=120.0)
    assert len(rotations.others_deg) == 2


def test_an_ambiguity_lasts_while_the_likelihoods_are_equal_and_moves_with_the_object() -> None:
    rotations = followed()
    update(rotations, 2.0, (0.0, 0.0), (60.0, 0.0))
    for k in range(1, 30):
        found = update(rotations, 2.0 + k * FRAME_S, (1.0 * k, 0.0), (60.0 + k, 0.0))
        assert found.rotation_deg is None
    assert rotations.last_deg == pytest.approx(29.0)
    assert rotations.others_deg == [pytest.approx(60.0)]


def test_a_likelihood_resolves_an_ambiguity() -> None:
    rotations = followed()
    update(rotations, 2.0, (0.0, 0.0), (60.0, 0.0))
    assert update(rotations, 2.0 + FRAME_S, (0.0, -8.0), (60.0, 0.0)).rotation_deg == 60.0
    assert not rotations.others_deg
    assert update(rotations, 2.0 + 2 * FRAME_S, (61.0, 0.0), (1.0, 0.0)).rotation_deg == 61.0


def test_a_jump_that_no_motion_explains_is_declined_and_forgotten() -> None:
    rotations = followed((FRAME_S, 0.5))
    for k in range(2, 4):
        found = update(rotations, k * FRAME_S, (120.0, 0.0))
        assert found.declined is not None
        assert found.declined.startswith(DeclineReason.UNCERTAIN)
    assert rotations.last_deg == 0.5
    assert update(rotations, 4 * FRAME_S, (3.0, 0.0)).rotation_deg == 3.0


def test_after_an_unseen_time_every_rotation_is_credible_once() -> None:
    rotations = RotationFilter()
    rotations.start(0.0, 14.0, unseen=True)
    assert rotations.reach_deg(0.0) == 180.0
    for k in range(1, 20):
        assert update(rotations, k * FRAME_S, (100.0, 0.0)).rotation_deg == 100.0
    assert rotations.reach_deg(20 * FRAME_S) < 10.0


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_values_that_are_not_finite_are_declined_and_change_nothing(bad: float) -> None:
    rotations = followed((FRAME_S, 0.5))
    for found in (Hypothesis(bad, 0.0), Hypothesis(1.0, bad)):
        assert rotations.update(2 * FRAME_S, [found]).declined == "too uncertain: not a number"
    assert rotations.last_deg == 0.5
    assert math.isfinite(rotations.reach_deg(3 * FRAME_S))


def test_a_kept_frame_and_an_unchanged_image_close_the_gap() -> None:
    kept, unchanged = followed((0.1, 0.0), (0.11, 0.1)), followed((0.1, 0.0), (0.11, 0.1))
    kept.note_kept(1.0)
    unchanged.unchanged(1.0)
    for rotations in (kept, unchanged):
        assert rotations.reach_deg(1.0 + FRAME_S) < 5.0
        assert rotations.last_deg == 0.1
    assert followed((0.1, 0.0)).reach_deg(1.0) == 180.0


@pytest.mark.parametrize("kept", [(1, 1, 1, 1, 1, 1, 1, 1), (1, 0, 1, 1, 0, 0, 1, 1)])
def test_the_rate_is_right_with_dropped_and_uneven_frames(kept: tuple[int, ...]) -> None:
    times = [k * FRAME_S + 0.001 * (k % 3) for k, keep in enumerate(kept * 2, start=1) if keep]
    rotations = followed(*((t, 120.0 * t) for t in times))
    assert rotations.rate_deg_s(times[-1]) == pytest.approx(120.0, rel=1e-6)


def test_an_unchanged_image_brings_the_rate_to_zero() -> None:
    rotations = followed(*((k * FRAME_S, 2.0 * k) for k in range(1, 8)))
    for k in range(8, 16):
        rotations.unchanged(k * FRAME_S)
    assert rotations.rate_deg_s(15 * FRAME_S) == pytest.approx(0.0, abs=1e-9)


def test_there_is_no_rate_of_few_old_or_simultaneous_rotations() -> None:
    assert followed((0.02, 1.0)).rate_deg_s(0.02) is None
    assert followed((0.02, 1.0), (0.04, 2.0)).rate_deg_s(0.04 + 2 * RATE_STALE_S) is None
    assert followed(*((5.0 + 1e-9 * k, 0.1 * (-1) ** k) for k in range(10))).rate_deg_s(5.0) is None


@pytest.mark.parametrize("back_s", [1e-9, 0.01, 0.1, 50.0, 1e6])
def test_rates_and_reach_recover_after_the_clock_went_back(back_s: float) -> None:
    rotations = RotationFilter()
    rotations.start(1e6)
    for k in range(1, 20):
        update(rotations, 1e6 + k * FRAME_S, (0.0, 0.0))
    for k in range(12):
        at_s = 1e6 + 19 * FRAME_S - back_s + k * FRAME_S
        assert update(rotations, at_s, (float(k), 0.0)).rotation_deg == k
    assert rotations.rate_deg_s(at_s) == pytest.approx(60.0, abs=1.0)
    assert rotations.reach_deg(at_s + FRAME_S) < 10.0


@given(st.lists(st.tuples(st.floats(-1e3, 1e3), st.floats(-400.0, 400.0), st.floats(-50.0, 0.0)), max_size=12))
def test_any_sequence_gives_a_rotation_that_was_found_or_a_reason(seen: list[tuple[float, float, float]]) -> None:
    rotations = RotationFilter()
    rotations.start(0.0)
    for at_s, rotation_deg, log_likelihood in seen:
        found = update(rotations, at_s, (rotation_deg, log_likelihood), (rotation_deg + 60.0, 0.0))
        assert (found.rotation_deg is None) == (found.declined is not None)
        assert found.rotation_deg in (None, rotation_deg, rotation_deg + 60.0)
        rate = rotations.rate_deg_s(at_s)
        assert rate is None or math.isfinite(rate)
        assert 0.0 <= rotations.reach_deg(at_s + FRAME_S) <= 180.0
