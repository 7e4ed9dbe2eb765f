"""Turns: signed, unwrapped, with a rate that survives dropped frames, and no turn out of a flip."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from slipguard.perception.rotation.axial_angle import (
    axial_difference_deg,
    axial_mean_deg,
    nearest_rotation_deg,
    wrap_axial_deg,
)
from slipguard.perception.rotation.fusion import (
    RotationEstimate,
    check_contour,
    fuse_axis_rotations,
    rotation_between_axes,
)
from slipguard.perception.rotation.rotation_tracker import RotationTracker

ANY_DEG = st.floats(-1e4, 1e4)


@pytest.mark.parametrize(("before", "now", "rotation"), [(-6, 6, 12), (80, -80, 20), (6, -6, -12), (-85, 85, -10)])
def test_published_cases_are_signed_and_cross_the_seam(before: float, now: float, rotation: float) -> None:
    assert rotation_between_axes(now, 0.5, before, 0.5, 0.0).rotation_deg == pytest.approx(rotation)


def test_sigma_is_that_of_both_axes() -> None:
    assert rotation_between_axes(10, 0.3, 0, 0.4, 0.0).sigma_deg == pytest.approx(0.5)


def test_turns_unwrap_past_a_right_angle() -> None:
    near = 0.0
    for true in range(0, 400, 7):
        rotation = rotation_between_axes(wrap_axial_deg(true + 33.0), 0.1, 33.0, 0.1, near).rotation_deg
        assert rotation == pytest.approx(true)
        assert rotation is not None
        near = rotation


@given(ANY_DEG)
def test_an_axis_lies_in_its_half_open_range(angle: float) -> None:
    wrapped = wrap_axial_deg(angle)
    assert -90.0 < wrapped <= 90.0
    assert math.isclose(math.sin(math.radians(wrapped - angle)), 0.0, abs_tol=1e-6)


@given(ANY_DEG, ANY_DEG)
def test_the_nearest_turn_is_within_a_right_angle(axis: float, near: float) -> None:
    assert abs(nearest_rotation_deg(axis, near) - near) <= 90.0 + 1e-6


def test_axes_average_across_the_seam() -> None:
    assert abs(axial_mean_deg([88.0, -88.0], [1.0, 1.0])) == pytest.approx(90.0)
    assert axial_difference_deg(-80, 80) == pytest.approx(20)


def tracked(rotations: list[tuple[float, float]]) -> RotationTracker:
    tracker = RotationTracker()
    tracker.start(0.0)
    for now_s, rotation in rotations:
        tracker.accept(now_s, RotationEstimate(rotation, 0.3))
    return tracker


@pytest.mark.parametrize("kept", [(1, 1, 1, 1, 1, 1, 1, 1), (1, 0, 1, 1, 0, 0, 1, 1), (1, 0, 0, 1, 0, 0, 0, 1)])
def test_the_rate_is_right_with_dropped_and_uneven_frames(kept: tuple[int, ...]) -> None:
    times = [k / 60 + 0.001 * (k % 3) for k, keep in enumerate(kept * 2, start=1) if keep]
    tracker = tracked([(t, 120.0 * t) for t in times])
    assert tracker.rate_deg_s(times[-1]) == pytest.approx(120.0, rel=1e-6)
    assert tracker.predicted_deg(times[-1] + 1 / 60) == pytest.approx(120.0 * (times[-1] + 1 / 60), abs=0.01)


def test_no_rate_from_too_few_or_too_old_turns() -> None:
    assert tracked([(0.02, 1.0)]).rate_deg_s(0.02) is None
    assert tracked([(0.02, 1.0), (0.04, 2.0)]).rate_deg_s(1.0) is None


def test_an_unchanged_picture_brings_the_rate_to_nothing() -> None:
    tracker = tracked([(k / 60, 2.0 * k) for k in range(1, 8)])
    for k in range(8, 16):
        tracker.unchanged(k / 60)
    assert tracker.rate_deg_s(15 / 60) == pytest.approx(0.0, abs=1e-9)


def test_a_flip_by_a_right_angle_never_becomes_a_turn() -> None:
    tracker = tracked([(0.02, 0.5)])
    for k in range(2, 200):
        assert tracker.accept(0.02 * k, RotationEstimate(85.0, 1.0)).declined is not None
    assert tracker.accept(5.0, RotationEstimate(3.0, 1.0)).rotation_deg == 3.0


def test_a_fast_turn_with_lost_frames_is_believed() -> None:
    tracker = tracked([(k / 60, 5.0 * k) for k in range(1, 5)])
    assert tracker.accept(8 / 60, RotationEstimate(40.0, 0.5)).rotation_deg == 40.0


def test_time_that_stands_still_or_goes_back_breaks_nothing() -> None:
    tracker = tracked([(0.1, 1.0), (0.1, 2.0), (0.05, 3.0)])
    rate = tracker.rate_deg_s(0.1)
    assert rate is None or math.isfinite(rate)


def test_registration_counts_where_the_axes_agree_with_it() -> None:
    assert check_contour(RotationEstimate(10.0, 0.5), RotationEstimate(11.0, 0.5)) == RotationEstimate(10.0, 0.5)
    assert check_contour(RotationEstimate(10.0, 2.0), RotationEstimate(11.0, 0.5)) == RotationEstimate(11.0, 0.5)


def test_two_turns_that_contradict_each_other_are_none() -> None:
    assert check_contour(RotationEstimate(10.0, 0.5), RotationEstimate(30.0, 0.5)).declined is not None
    near = check_contour(RotationEstimate(10.0, 0.5), RotationEstimate(14.0, 0.6))
    assert near.rotation_deg == 10.0
    assert near.sigma_deg == pytest.approx(2.0)


def test_one_turn_is_enough_and_none_keeps_its_reason() -> None:
    assert check_contour(RotationEstimate(None, None, "round contact"), RotationEstimate(3.0, 1.0)).rotation_deg == 3.0
    assert check_contour(RotationEstimate(3.0, 1.0), RotationEstimate(None, None, "round contact")).rotation_deg == 3.0
    assert check_contour(RotationEstimate(None, None, "a"), RotationEstimate(None, None, "b")).declined == "a"
    assert (
        check_contour(RotationEstimate(24.7, 4.1), RotationEstimate(None, None, "clipped by the frame")).rotation_deg
        is None
    )
    assert check_contour(RotationEstimate(24.7, 4.1), RotationEstimate(24.0, 4.1)).rotation_deg == 24.7
    assert fuse_axis_rotations([RotationEstimate(None, None, "a"), RotationEstimate(None, None, "b")]).declined == "a"


def test_an_estimator_that_disagrees_widens_sigma() -> None:
    rotation = fuse_axis_rotations(
        [RotationEstimate(10.0, 0.5), RotationEstimate(10.4, 0.6), RotationEstimate(22.0, 1.0)]
    )
    assert rotation.rotation_deg == pytest.approx(10.16, abs=0.02)
    assert rotation.sigma_deg == pytest.approx(3.0)
