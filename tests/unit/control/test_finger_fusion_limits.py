"""The fused estimate, every field, at and next to every limit."""

from __future__ import annotations

import math

import pytest
from observations import estimate
from records import changed

from slipguard.control.finger_fusion import GAP_MAX_S, FusedEstimate, fuse

LEFT = changed(estimate(4.0, 0.5, at_s=8.0, measured_s=7.5, shift_mm=(9.0, -1.0)), rate_deg_s=16.0)
RIGHT = changed(estimate(-6.0, 1.0, at_s=8.0, measured_s=7.25, shift_mm=(-9.0, -3.0)), rate_deg_s=-6.0)


def test_both() -> None:
    assert fuse(LEFT, RIGHT) == FusedEstimate(
        left_contact=True,
        right_contact=True,
        captured_at_s=8.0,
        measured_at_s=7.25,
        fingers=("left", "right"),
        rotation_deg=pytest.approx((4.0 * 4.0 + 6.0) / 5.0),
        sigma_deg=pytest.approx(5.0**-0.5),
        rate_deg_s=pytest.approx((4.0 * 16.0 + 6.0) / 5.0),
        shift_mm=2.0,
        newest_at_s=7.5,
        sideways_mm=9.0,
        shift_fingers=("left", "right"),
    )


def test_one_declines() -> None:
    without_estimate = changed(RIGHT, rotation_deg=None, sigma_deg=None, declined="round contact")
    assert fuse(LEFT, without_estimate) == FusedEstimate(
        True, True, 8.0, 7.5, ("left",), 4.0, 0.5, 16.0, 2.0, None, "right finger: round contact", newest_at_s=7.5,
        sideways_mm=9.0, shift_fingers=("left", "right"),
    )  # fmt: skip


def test_one_is_silent() -> None:
    assert fuse(None, RIGHT) == FusedEstimate(
        None, True, 8.0, 7.25, ("right",), 6.0, 1.0, 6.0, 3.0, None, "left finger: no frames", newest_at_s=7.25,
        sideways_mm=9.0, shift_fingers=("right",),
    )  # fmt: skip


def test_both_decline() -> None:
    without_estimate = [changed(one, rotation_deg=None, sigma_deg=None, declined=None) for one in (LEFT, RIGHT)]
    away = changed(without_estimate[1], contact=False, shift_mm=None)
    assert fuse(without_estimate[0], away) == FusedEstimate(
        True,
        False,
        8.0,
        7.25,
        shift_mm=1.0,
        declined="left finger: no reference yet; right finger: no contact",
        newest_at_s=7.5,
        sideways_mm=9.0,
        shift_fingers=("left",),
    )


@pytest.mark.parametrize(
    ("right_mm", "opposed"), [((-9.0, 7.4), False), ((-9.0, 11.0), True), ((5.0, -1.0), True), ((-3.0, -1.0), False)]
)
def test_shifts_that_no_object_makes_are_a_contradiction(right_mm: tuple[float, float], opposed: bool) -> None:
    answer = fuse(LEFT, changed(RIGHT, shift_mm=right_mm))
    assert answer is not None
    assert answer.conflict is None
    assert (answer.shift_conflict is not None) is opposed
    if opposed:
        assert "shifts contradict each other" in (answer.shift_conflict or "")
        larger = max(((9.0, 1.0), (-right_mm[0], -right_mm[1])), key=lambda shift: math.hypot(*shift))
        assert (answer.sideways_mm, answer.shift_mm) == larger
        silent = fuse(
            changed(LEFT, rotation_deg=None, sigma_deg=None), changed(RIGHT, shift_mm=right_mm, sigma_deg=None)
        )
        assert silent is not None
        assert silent.shift_conflict == answer.shift_conflict


def test_the_later_one_is_moved_back_by_its_own_rate() -> None:
    late = changed(RIGHT, captured_at_s=8.0625, rotation_deg=-4.375, sigma_deg=0.5)
    answer = fuse(LEFT, late)
    assert answer is not None
    assert answer.captured_at_s == 8.0
    assert answer.rotation_deg == pytest.approx((4.0 + 4.375 - 0.0625 * 6.0) / 2.0)
    assert answer.note is None
    unknown = fuse(LEFT, changed(late, rate_deg_s=None))
    assert unknown is not None
    assert unknown.rotation_deg == pytest.approx((4.0 + 4.375 - 0.0625 * 16.0) / 2.0)
    assert unknown.rate_deg_s == 16.0


@pytest.mark.parametrize(("gap_s", "fingers"), [(GAP_MAX_S, ("left", "right")), (0.125, ("right",))])
def test_far_behind_is_left_out(gap_s: float, fingers: tuple[str, ...]) -> None:
    early, late = changed(LEFT, captured_at_s=0.0), changed(RIGHT, captured_at_s=gap_s)
    answer = fuse(early, late)
    assert answer is not None
    assert answer.fingers == fingers
    assert answer.note == (None if len(fingers) == 2 else "left finger: 125 ms behind")


def test_without_a_rate_only_the_newer_counts() -> None:
    early, late = changed(LEFT, rate_deg_s=None), changed(RIGHT, captured_at_s=8.0625, rate_deg_s=None)
    answer = fuse(early, late)
    assert answer is not None
    assert (answer.fingers, answer.rotation_deg) == (("right",), 6.0)
    assert answer.note == "left finger: older, and its rate is unknown"
    together = fuse(early, changed(late, captured_at_s=8.0))
    assert together is not None
    assert together.fingers == ("left", "right")


def test_disagreement_is_worth_less() -> None:
    far = changed(RIGHT, rotation_deg=-7.0, sigma_deg=0.5)
    answer = fuse(LEFT, far)
    assert answer is not None
    assert answer.conflict is None
    assert answer.rotation_deg == pytest.approx(5.5)
    assert answer.sigma_deg == pytest.approx(0.5 / 2**0.5 * 3.0 / (0.5 * 2**0.5))


@pytest.mark.parametrize(("right_deg", "fused_deg", "sigma_deg"), [(6.0, -6.0, 0.25), (3.0, 4.0, 0.5)])
def test_the_same_sign_in_both_images(right_deg: float, fused_deg: float, sigma_deg: float) -> None:
    answer = fuse(LEFT, changed(RIGHT, rotation_deg=right_deg, sigma_deg=0.25))
    assert answer is not None
    assert (answer.rotation_deg, answer.sigma_deg) == (fused_deg, sigma_deg)
    assert answer.conflict == (
        f"both images rotate the same way (left +4.0°, right +{right_deg:.1f}°): "
        "a fault of one finger, or the object rolls"
    )


@pytest.mark.parametrize(("right_deg", "opposite"), [(0.75, False), (0.8125, True)])
def test_an_uncertain_rotation_contradicts_no_finger(right_deg: float, opposite: bool) -> None:
    answer = fuse(changed(LEFT, rotation_deg=1.75), changed(RIGHT, rotation_deg=right_deg, sigma_deg=0.25))
    assert answer is not None
    assert (answer.conflict is not None) is opposite


@pytest.mark.parametrize(
    ("left_deg", "right_deg", "sigma_deg", "rotation_deg"),
    [
        (0.0, -3.5, 0.125, 3.5),
        (0.0, -3.25, 0.125, None),
        (0.0, 3.5, 0.125, -3.5),
        (-3.5, 0.0, 0.125, -3.5),
        (20.0, -14.75, 0.125, 20.0),
        (20.0, -15.25, 0.125, None),
        (0.0, -3.75, 0.875, 3.75),
        (0.0, -3.5, 0.875, None),
    ],
)
def test_one_finger_rotates_alone(
    left_deg: float, right_deg: float, sigma_deg: float, rotation_deg: float | None
) -> None:
    """Beyond 3 degrees, a tenth of the rotation and three combined standard deviations, the larger one is used."""
    left = changed(LEFT, rotation_deg=left_deg, sigma_deg=sigma_deg)
    right = changed(RIGHT, rotation_deg=right_deg, sigma_deg=sigma_deg)
    answer = fuse(left, right)
    assert answer is not None
    assert answer.fingers == ("left", "right")
    if rotation_deg is None:
        assert answer.conflict is None
        return
    assert answer.conflict == (
        f"the fingers contradict each other (left {left_deg:+.1f}°, right {-right_deg:+.1f}°): "
        "one is stuck or wrong, the larger rotation is used"
    )
    used = left if abs(left_deg) > abs(right_deg) else right
    assert (answer.rotation_deg, answer.sigma_deg) == (rotation_deg, sigma_deg)
    assert answer.rate_deg_s == (16.0 if used is left else 6.0)
    assert answer.measured_at_s == answer.newest_at_s == used.measured_at_s
    assert answer.captured_at_s == 8.0


def test_a_rotation_without_a_sigma_is_none() -> None:
    answer = fuse(changed(LEFT, sigma_deg=None), RIGHT)
    assert answer is not None
    assert (answer.fingers, answer.note) == (("right",), "left finger: no reference yet")
