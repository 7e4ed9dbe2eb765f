"""Rotations are signed and unwrapped, with a rate that survives dropped frames; a flip is not a rotation."""

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
)
from slipguard.perception.rotation.rotation_tracker import RATE_STALE_S, RotationTracker

ANY_DEG = st.floats(-1e4, 1e4)


def tracked(rotations: list[tuple[float, float]]) -> RotationTracker:
    tracker = RotationTracker()
    tracker.start(0.0)
    for now_s, rotation in rotations:
        tracker.accept(now_s, RotationEstimate(rotation, 0.3))
    return tracker


def rotating(tracker: RotationTracker, from_s: float, rate_deg_s: float, frames: int) -> float | None:
    """The rate after a number of regular frames of a steady rotation."""
    for k in range(frames):
        tracker.accept(from_s + k / 60, RotationEstimate(rate_deg_s * k / 60, 0.3))
    return tracker.rate_deg_s(from_s + (frames - 1) / 60)


@given(ANY_DEG)
def test_an_axis_lies_in_the_half_open_range(angle: float) -> None:
    wrapped = wrap_axial_deg(angle)
    assert -90.0 < wrapped <= 90.0
    assert math.isclose(math.sin(math.radians(wrapped - angle)), 0.0, abs_tol=1e-6)


@given(ANY_DEG, ANY_DEG)
def test_the_nearest_rotation_is_within_90_degrees(axis: float, near: float) -> None:
    assert abs(nearest_rotation_deg(axis, near) - near) <= 90.0 + 1e-6


def test_axes_average_across_90_degrees() -> None:
    assert abs(axial_mean_deg([88.0, -88.0], [1.0, 1.0])) == pytest.approx(90.0)
    assert axial_difference_deg(-80, 80) == pytest.approx(20)


@pytest.mark.parametrize("kept", [(1, 1, 1, 1, 1, 1, 1, 1), (1, 0, 1, 1, 0, 0, 1, 1), (1, 0, 0, 1, 0, 0, 0, 1)])
def test_the_rate_is_correct_with_dropped_and_uneven_frames(kept: tuple[int, ...]) -> None:
    times = [k / 60 + 0.001 * (k % 3) for k, keep in enumerate(kept * 2, start=1) if keep]
    tracker = tracked([(t, 120.0 * t) for t in times])
    assert tracker.rate_deg_s(times[-1]) == pytest.approx(120.0, rel=1e-6)
    assert tracker.predicted_deg(times[-1] + 1 / 60) == pytest.approx(120.0 * (times[-1] + 1 / 60), abs=0.01)


def test_no_rate_from_too_few_or_too_old_rotations() -> None:
    assert tracked([(0.02, 1.0)]).rate_deg_s(0.02) is None
    assert tracked([(0.02, 1.0), (0.04, 2.0)]).rate_deg_s(1.0) is None


def test_an_unchanged_image_brings_the_rate_to_zero() -> None:
    tracker = tracked([(k / 60, 2.0 * k) for k in range(1, 8)])
    for k in range(8, 16):
        tracker.unchanged(k / 60)
    assert tracker.rate_deg_s(15 / 60) == pytest.approx(0.0, abs=1e-9)


def test_a_flip_by_90_degrees_is_never_a_rotation() -> None:
    tracker = tracked([(0.02, 0.5)])
    for k in range(2, 200):
        assert tracker.accept(0.02 * k, RotationEstimate(85.0, 1.0)).declined is not None
    assert tracker.accept(5.0, RotationEstimate(3.0, 1.0)).rotation_deg == 3.0


@pytest.mark.parametrize(("apart_s", "agreeing"), [(1 / 60, True), (0.1, True), (0.2, False)])
def test_only_rotations_of_recent_frames_agree(apart_s: float, agreeing: bool) -> None:
    tracker = tracked([(0.0, 0.0)])
    for k in range(1, 4):
        assert tracker.accept(k * apart_s, RotationEstimate(90.0, 0.3)).rotation_deg is None
    assert (tracker.offered_deg is not None) is agreeing


def test_a_rotation_known_to_be_unchanged_is_not_extrapolated_from_before() -> None:
    tracker = tracked([(0.1, 0.0), (0.11, 0.1)])
    assert tracker.extrapolated_deg(0.21) == pytest.approx(1.1)
    tracker.note_kept(0.2)
    assert tracker.extrapolated_deg(0.21) == pytest.approx(0.2)


def test_a_fast_rotation_with_lost_frames_is_accepted() -> None:
    tracker = tracked([(k / 60, 5.0 * k) for k in range(1, 5)])
    assert tracker.accept(8 / 60, RotationEstimate(40.0, 0.5)).rotation_deg == 40.0


def test_equal_or_decreasing_times_are_accepted() -> None:
    tracker = tracked([(0.1, 1.0), (0.1, 2.0), (0.05, 3.0)])
    rate = tracker.rate_deg_s(0.1)
    assert rate is None or math.isfinite(rate)


@pytest.mark.parametrize("back_s", [1e-9, 0.01, 0.1, 50.0, 1e6])
def test_the_rate_recovers_after_the_clock_went_back(back_s: float) -> None:
    tracker = RotationTracker()
    tracker.start(1e6)
    rotating(tracker, 1e6, 0.0, 20)
    assert rotating(tracker, 1e6 + 19 / 60 - back_s, 60.0, 12) == pytest.approx(60.0, abs=1.0)


def test_frames_a_nanosecond_apart_give_no_rate() -> None:
    tracker = RotationTracker()
    tracker.start(5.0)
    for k in range(10):
        tracker.accept(5.0 + k * 1e-9, RotationEstimate(0.1 * (-1) ** k, 0.1))
    assert tracker.rate_deg_s(5.0 + RATE_STALE_S / 2) is None


@pytest.mark.parametrize(
    "bad",
    [
        RotationEstimate(math.nan, 1.0),
        RotationEstimate(1.0, math.nan),
        RotationEstimate(math.inf, 1.0),
        RotationEstimate(1.0, math.inf),
    ],
)
def test_the_tracker_declines_values_that_are_not_finite(bad: RotationEstimate) -> None:
    tracker = RotationTracker()
    tracker.start(0.0)
    assert tracker.accept(0.1, bad).declined == "not a number"
    assert tracker.predicted_deg(0.1) == 0.0
