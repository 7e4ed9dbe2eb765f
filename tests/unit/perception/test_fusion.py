"""One rotation from texture, contour and axis: agreement, disagreement, and reasons where all decline."""

from __future__ import annotations

import pytest

from slipguard.perception.rotation.axial_angle import (
    wrap_axial_deg,
)
from slipguard.perception.rotation.fusion import (
    RotationEstimate,
    check_contour,
    fuse_axis_rotations,
    fuse_rotation,
    needs_contour,
    rotation_between_axes,
    widen_for_slip,
)

NO_CONTOUR = RotationEstimate(None, None, "round contact")


@pytest.mark.parametrize(("before", "now", "rotation"), [(-6, 6, 12), (80, -80, 20), (6, -6, -12), (-85, 85, -10)])
def test_published_cases_are_signed_and_cross_90_degrees(before: float, now: float, rotation: float) -> None:
    assert rotation_between_axes(now, 0.5, before, 0.5, 0.0).rotation_deg == pytest.approx(rotation)


def test_sigma_combines_that_of_both_axes() -> None:
    assert rotation_between_axes(10, 0.3, 0, 0.4, 0.0).sigma_deg == pytest.approx(0.5)


def test_rotations_unwrap_past_90_degrees() -> None:
    near = 0.0
    for true in range(0, 400, 7):
        rotation = rotation_between_axes(wrap_axial_deg(true + 33.0), 0.1, 33.0, 0.1, near).rotation_deg
        assert rotation == pytest.approx(true)
        assert rotation is not None
        near = rotation


def test_a_contour_confirmed_by_the_axis_counts() -> None:
    assert check_contour(RotationEstimate(10.0, 0.5), RotationEstimate(11.0, 0.5)) == RotationEstimate(10.0, 0.5)
    assert check_contour(RotationEstimate(10.0, 2.0), RotationEstimate(11.0, 0.5)) == RotationEstimate(11.0, 0.5)


def test_contradicting_contour_and_axis_are_declined() -> None:
    assert check_contour(RotationEstimate(10.0, 0.5), RotationEstimate(30.0, 0.5)).declined is not None
    near = check_contour(RotationEstimate(10.0, 0.5), RotationEstimate(14.0, 0.6))
    assert near.rotation_deg == 10.0
    assert near.sigma_deg == pytest.approx(2.0)


def test_one_rotation_is_enough_and_if_all_decline_the_first_reason_counts() -> None:
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


def test_without_a_contour_texture_and_axis_are_averaged_by_their_sigmas() -> None:
    fused = fuse_rotation(RotationEstimate(10.0, 0.3), None, RotationEstimate(10.5, 0.6))
    assert fused.rotation_deg == pytest.approx(10.1)
    assert fused.sigma_deg == pytest.approx(0.268, abs=1e-3)
    assert fuse_rotation(RotationEstimate(10.0, 0.3), None, None) == RotationEstimate(10.0, 0.3)
    assert fuse_rotation(None, None, RotationEstimate(3.0, 1.0)) == RotationEstimate(3.0, 1.0)


def test_a_deformed_contact_increases_the_sigma_of_the_contour() -> None:
    contour, axis = RotationEstimate(10.0, 0.5), RotationEstimate(10.2, 0.5)
    assert fuse_rotation(None, contour, axis, deformation=3.0) == RotationEstimate(10.0, 1.5)
    fused = fuse_rotation(RotationEstimate(11.0, 1.5), contour, axis, deformation=3.0)
    assert fused.rotation_deg == pytest.approx(10.5)


def test_if_all_decline_the_reason_of_the_texture_counts_then_that_of_the_contour() -> None:
    texture, axis = RotationEstimate(None, None, "clipped by the frame"), RotationEstimate(None, None, "axis")
    assert fuse_rotation(texture, NO_CONTOUR, axis).declined == "clipped by the frame"
    assert fuse_rotation(None, NO_CONTOUR, axis).declined == "round contact"


def test_texture_and_contour_far_apart_are_declined_with_values_and_limit() -> None:
    declined = fuse_rotation(RotationEstimate(10.0, 0.5), RotationEstimate(30.0, 0.5), None).declined
    assert declined == "estimators disagree: texture and contour are 20.0 deg apart, limit 8 deg"


def test_a_certain_texture_that_the_axis_does_not_contradict_needs_no_contour() -> None:
    assert not needs_contour(RotationEstimate(10.0, 0.5), RotationEstimate(10.4, 0.5))
    assert not needs_contour(RotationEstimate(10.0, 0.5), NO_CONTOUR)
    assert needs_contour(RotationEstimate(10.0, 0.5), RotationEstimate(15.0, 0.5))
    assert needs_contour(RotationEstimate(10.0, 0.9), RotationEstimate(10.4, 0.5))
    assert needs_contour(None, RotationEstimate(10.4, 0.5))


@pytest.mark.parametrize(
    ("rotation_deg", "twist_deg", "smooth", "sigma_deg"),
    [
        (0.0, 0.0, True, 0.1),
        (10.0, 0.0, False, 0.51),
        (-150.0, 0.0, False, 1.0),
        (0.0, 2.0, False, 2.0),
        (0.0, 2.0, True, 3.0),
    ],
)
def test_partial_slip_widens_sigma_most_for_smooth_contacts(
    rotation_deg: float, twist_deg: float, smooth: bool, sigma_deg: float
) -> None:
    widened = widen_for_slip(RotationEstimate(rotation_deg, 0.1), twist_deg, smooth)
    assert (widened.rotation_deg, widened.sigma_deg) == (rotation_deg, pytest.approx(sigma_deg, abs=0.01))
    assert widen_for_slip(NO_CONTOUR, twist_deg, smooth) == NO_CONTOUR
