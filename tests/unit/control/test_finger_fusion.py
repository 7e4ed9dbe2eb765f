"""The estimates of two fingers fused into one rotation."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st
from observations import estimate

from slipguard.control.finger_fusion import SIGMA_FLOOR_DEG, fuse
from slipguard.perception.estimate import Estimate

rotations = st.floats(-60.0, 60.0)
sigmas = st.floats(0.05, 6.0)


def test_without_estimates_there_is_no_fused_estimate() -> None:
    assert fuse(None, None) is None


def test_a_rotation_has_opposite_signs_in_the_two_images() -> None:
    both = fuse(estimate(12.0), estimate(-12.0))
    assert both is not None
    assert both.rotation_deg == pytest.approx(12.0)
    assert both.sigma_deg == pytest.approx(0.5 / math.sqrt(2))
    assert both.fingers == ("left", "right")
    assert both.conflict is None
    assert both.note is None
    assert both.both_touch


def test_from_minus_6_to_plus_6_is_12_and_80_to_100_is_20() -> None:
    """The published code, which averages magnitudes, reads 0 for both."""
    for rotation in (12.0, 20.0):
        both = fuse(estimate(rotation), estimate(-rotation))
        assert both is not None
        assert both.rotation_deg == pytest.approx(rotation)


def test_the_surer_finger_weighs_more() -> None:
    both = fuse(estimate(10.0, 0.5), estimate(-11.0, 1.0))
    assert both is not None
    assert both.rotation_deg == pytest.approx((4 * 10 + 1 * 11) / 5)
    assert both.sigma_deg == pytest.approx((4 + 1) ** -0.5)


def test_rates_and_shifts_are_fused_too() -> None:
    both = fuse(
        estimate(10.0, rate_deg_s=30.0, shift_mm=(3.0, -0.8)), estimate(-10.0, rate_deg_s=-20.0, shift_mm=(-3.0, -0.6))
    )
    assert both is not None
    assert both.rate_deg_s == pytest.approx(25.0)
    assert both.shift_mm == pytest.approx(0.7)  # down is positive
    one = fuse(estimate(10.0, rate_deg_s=30.0, shift_mm=(0.0, 0.5)), estimate(-10.0))
    assert one is not None
    assert one.rate_deg_s == pytest.approx(30.0)
    assert one.shift_mm == pytest.approx(-0.5)


@pytest.mark.parametrize(
    ("left", "right", "rotation", "finger", "note"),
    [
        (estimate(8.0), None, 8.0, "left", "right finger: no frames"),
        (None, estimate(8.0), -8.0, "right", "left finger: no frames"),
        (estimate(8.0), estimate(None, declined="round contact"), 8.0, "left", "right finger: round contact"),
        (estimate(None), estimate(8.0), -8.0, "right", "left finger: no reference yet"),
        (estimate(None, contact=False), estimate(8.0), -8.0, "right", "left finger: no contact"),
    ],
)
def test_one_finger_without_estimate_leaves_the_other_with_a_note(
    left: object, right: object, rotation: float, finger: str, note: str
) -> None:
    one = fuse(left, right)  # type: ignore[arg-type]
    assert one is not None
    assert one.rotation_deg == pytest.approx(rotation)
    assert one.sigma_deg == pytest.approx(0.5)
    assert one.fingers == (finger,)
    assert one.note == note
    assert one.conflict is None


def test_two_fingers_without_estimate_decline_with_both_reasons() -> None:
    none = fuse(estimate(None, declined="round contact", shift_mm=(0.0, -1.0)), estimate(None, contact=False))
    assert none is not None
    assert none.rotation_deg is None
    assert none.sigma_deg is None
    assert none.declined == "left finger: round contact; right finger: no contact"
    assert none.shift_mm == 1.0


def test_contact() -> None:
    unusable = estimate(None, contact=True, declined="image unusable: mean of 9 gray levels")

    def touch(left: Estimate | None, right: Estimate | None) -> tuple[bool | None, bool | None, bool]:
        both = fuse(left, right)
        assert both is not None
        return both.left_contact, both.right_contact, both.both_touch

    yes, no = estimate(None, contact=True), estimate(None, contact=False)
    assert touch(yes, yes) == (True, True, True)
    assert touch(yes, no) == (True, False, False)
    assert touch(no, no) == (False, False, False)
    assert touch(None, no) == (None, False, False)
    assert touch(unusable, yes) == (None, True, False)
    assert touch(unusable, unusable) == (None, None, False)


def test_the_same_sign_in_both_images_is_a_conflict_and_the_larger_rotation_is_used() -> None:
    both = fuse(estimate(5.0), estimate(9.0))
    assert both is not None
    assert both.conflict is not None
    assert "left +5.0°, right +9.0°" in both.conflict
    assert both.rotation_deg == pytest.approx(-9.0)


def test_opposite_within_the_noise_is_no_conflict() -> None:
    for left, right in ((1.0, 1.0), (2.0, 1.0), (1.0, 2.0)):
        both = fuse(estimate(left), estimate(right))
        assert both is not None
        assert both.conflict is None


def test_disagreement_widens_sigma() -> None:
    apart = fuse(estimate(10.0), estimate(-7.0))
    assert apart is not None
    assert apart.rotation_deg == pytest.approx(8.5)
    assert apart.conflict is None
    # Birge: sigma / sqrt(2) times the disagreement over its own sigma.
    assert apart.sigma_deg == pytest.approx(0.5 / math.sqrt(2) * 3.0 / math.hypot(0.5, 0.5))


def test_the_newer_rotation_is_moved_back_to_the_moment_of_the_older() -> None:
    both = fuse(estimate(10.0, at_s=1.00, rate_deg_s=100.0), estimate(-12.0, at_s=1.02, rate_deg_s=-100.0))
    assert both is not None
    assert both.captured_at_s == both.measured_at_s == 1.00
    assert both.rotation_deg == pytest.approx(10.0)
    assert both.sigma_deg == pytest.approx(0.5 / math.sqrt(2))


def test_a_finger_far_behind_is_left_out() -> None:
    one = fuse(estimate(10.0, at_s=1.0), estimate(-40.0, at_s=1.15))
    assert one is not None
    assert one.rotation_deg == pytest.approx(40.0)
    assert one.fingers == ("right",)
    assert one.captured_at_s == 1.15
    assert one.note == "left finger: 150 ms behind"


def test_a_skipped_frame_keeps_its_age() -> None:
    both = fuse(estimate(10.0, at_s=1.0, measured_s=0.8), estimate(-10.0, at_s=1.0))
    assert both is not None
    assert both.captured_at_s == 1.0
    assert both.measured_at_s == 0.8


@given(rotations, sigmas, rotations, sigmas)
def test_both_fingers_mirrored_give_the_mirrored_rotation(a: float, sa: float, b: float, sb: float) -> None:
    one, other = fuse(estimate(a, sa), estimate(b, sb)), fuse(estimate(-a, sa), estimate(-b, sb))
    assert one is not None
    assert other is not None
    assert one.rotation_deg is not None
    assert one.sigma_deg is not None
    assert other.rotation_deg == pytest.approx(-one.rotation_deg)
    assert other.sigma_deg == pytest.approx(one.sigma_deg)
    assert one.sigma_deg >= SIGMA_FLOOR_DEG / math.sqrt(2)
    assert min(a, -b) - 1e-9 <= one.rotation_deg <= max(a, -b) + 1e-9


def test_a_slide_counts_only_while_no_finger_knows_the_shift() -> None:
    slides = replace(estimate(1.0), shift_declined="periodic texture, shift ambiguous", slides=True)
    for left, right, expected in (
        (slides, None, True),
        (slides, estimate(-1.0), True),
        (slides, estimate(-1.0, shift_mm=(0.0, 0.0)), False),
        (replace(slides, slides=False), estimate(-1.0), False),
        (replace(slides, rotation_deg=math.nan), None, False),
    ):
        both = fuse(left, right)
        assert both is not None
        assert both.slides is expected


@pytest.mark.parametrize(
    ("left_mm", "right_mm", "fused_mm"),
    [(4.0, 6.0, 5.0), (None, 6.0, 6.0), (None, None, None), (math.nan, 6.0, 6.0), (0.0, math.inf, None)],
)
def test_the_contact_is_the_mean_of_those_seen(
    left_mm: float | None, right_mm: float | None, fused_mm: float | None
) -> None:
    left, right = (replace(estimate(), contact_radius_mm=radius_mm) for radius_mm in (left_mm, right_mm))
    together = fuse(left, right)
    assert together is not None
    assert together.contact_radius_mm == fused_mm
