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


def test_opposite_within_the_noise_is_no_conflict() -> None:
    for left, right in ((1.0, 1.0), (2.0, 1.0), (1.0, 2.0)):
        both = fuse(estimate(left), estimate(right))
        assert both is not None
        assert both.conflict is None


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


@pytest.mark.parametrize("at_s", [math.nan, math.inf])
def test_a_finger_without_a_valid_time_is_ignored(at_s: float) -> None:
    both = fuse(estimate(10.0, at_s=at_s), estimate(-12.0))
    assert both is not None
    assert both.rotation_deg == pytest.approx(12.0)
    assert both.left_contact is None
    assert fuse(estimate(10.0, at_s=at_s), None) is None
