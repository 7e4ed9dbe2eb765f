"""One look at a time: every field of what is remembered and of what was seen, at and beside the limits."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from observations import arm, fused

from slipguard.control.finger_fusion import FusedEstimate
from slipguard.control.params import GuardParams
from slipguard.control.slip_baselines import Handover, SlipMemory
from slipguard.control.slip_detector import SlipAssessment, look
from slipguard.control.slip_thresholds import MotionCase, RestingPlace
from slipguard.devices import ArmState

PARAMS = GuardParams()
NOW_S = 10.05
BEFORE = SlipMemory(
    base_rotation_deg=4.0, base_shift_mm=1.0, measured_s=10.0, captured_s=10.0, rotations=0, slides=0,
    told_by=("left", "right"), told_deg=5.0, told_s=10.0, handed_deg=0.1, handed_mm=0.05, smooth_shift_mm=1.2,
    slip_rate_mm_s=2.0, rest_rotation_deg=4.9, rest_shift_mm=1.1, rest_since_s=9.0,
    alert=RestingPlace(start_mm=0.0, near_deg=4.5, before_deg=4.6, rested_deg=4.4, measured_s=10.0),
)  # fmt: skip
"""The arm moves, or nobody knows."""


def observation(rotation_deg: float | None = 5.0, rate_deg_s: float | None = 0.0, **changes: object) -> FusedEstimate:
    told = fused(rotation_deg, rate_deg_s, at_s=NOW_S, shift_mm=1.3, sigma_deg=0.1)
    return replace(told, **{"newest_at_s": NOW_S, **changes})  # type: ignore[arg-type]


def at_rest(rotation_deg: float = 5.0, **changes: object) -> SlipMemory:
    """At rest in the air for a while, at that turn."""
    alert = RestingPlace(
        start_mm=0.0, near_deg=rotation_deg, before_deg=rotation_deg, rested_deg=rotation_deg, measured_s=10.0, case=MotionCase.REST,
        aloft=True,
    )  # fmt: skip
    before = replace(
        BEFORE, base_rotation_deg=rotation_deg, told_deg=rotation_deg, rest_rotation_deg=rotation_deg, alert=alert
    )
    return replace(before, **changes)  # type: ignore[arg-type]


def stands(height_mm: float = 200.0) -> ArmState:
    return arm(height_mm, at_s=NOW_S)


def test_a_change_of_finger_moves_every_place_that_is_remembered() -> None:
    """0.8 degrees further, of which the object has turned 0.6; 0.3 mm, of which it has slid 0.1."""
    sight = look(BEFORE, observation(5.8, 12.0, fingers=("left",), shift_mm=1.5), PARAMS)
    smooth_mm = 1.4 + (1.0 - math.exp(-1.0)) * 0.1
    rate_mm_s = (1.5 - smooth_mm) / 0.05
    assert sight == SlipAssessment(
        detector=SlipMemory(
            base_rotation_deg=pytest.approx(4.2),
            base_shift_mm=pytest.approx(1.2),
            measured_s=NOW_S,
            captured_s=NOW_S,
            told_by=("left",),
            told_deg=5.8,
            told_s=NOW_S,
            handed_deg=pytest.approx(0.3),
            handed_mm=pytest.approx(0.25),
            known=((("left", "right"), 0.1),),
            handover=Handover(5.0, 10.0, None, pytest.approx(0.2), NOW_S),
            smooth_shift_mm=pytest.approx(smooth_mm),
            slip_rate_mm_s=pytest.approx(rate_mm_s),
            rest_rotation_deg=pytest.approx(5.1),
            rest_shift_mm=pytest.approx(1.3),
            rest_since_s=9.0,
            alert=RestingPlace(
                start_mm=0.0,
                near_deg=pytest.approx(4.7),
                before_deg=pytest.approx(4.8),
                rested_deg=pytest.approx(4.6),
                measured_s=NOW_S,
            ),
        ),
        rotation_deg=pytest.approx(1.6),
        rate_deg_s=12.0,
        slip_mm=pytest.approx(0.3),
        slip_rate_mm_s=pytest.approx(rate_mm_s),
        moving=True,
        still_s=pytest.approx(NOW_S - 9.0),
    )


def test_told_anew_without_a_new_measurement_it_is_the_same_frame() -> None:
    before = replace(BEFORE, measured_s=NOW_S, frames=1, far_frames=1)
    after = look(before, observation(5.8, 12.0, fingers=("left",), shift_mm=1.5), PARAMS).detector
    assert (after.told_deg, after.told_s) == (pytest.approx(5.2), 10.0)
    assert (after.frames, after.far_frames, after.measured_s) == (1, 1, NOW_S)


def test_a_finger_without_rate_or_shift_is_taken_as_it_is() -> None:
    after = look(BEFORE, observation(5.3, None, fingers=("right",), shift_mm=None), PARAMS).detector
    assert (after.base_rotation_deg, after.handed_deg) == (pytest.approx(4.3), pytest.approx(0.4))
    assert (after.base_shift_mm, after.handed_mm, after.smooth_shift_mm) == (1.0, 0.05, None)


@pytest.mark.parametrize(
    ("rotation_deg", "rate_deg_s", "by_deg"),
    [(5.05, 0.0, 0.05), (5.5, 0.0, 0.2), (4.9, 0.0, -0.1), (4.7, 0.0, 0.2), (6.25, 12.0, 0.05)],
)
def test_what_a_change_of_finger_moves_is_the_smaller_of_two_looks(
    rotation_deg: float, rate_deg_s: float, by_deg: float
) -> None:
    """The first frame said 0.2; by the second's rate the object may have turned since."""
    first = look(BEFORE, observation(5.2, fingers=("left",)), PARAMS).detector
    again = observation(
        rotation_deg, rate_deg_s, fingers=("left",), captured_at_s=NOW_S + 0.05, measured_at_s=NOW_S + 0.05
    )
    second = look(first, again, PARAMS).detector
    assert (second.base_rotation_deg, second.handed_deg) == (pytest.approx(4.0 + by_deg), pytest.approx(0.1 + by_deg))
    assert second.alert.rested_deg == pytest.approx(4.4 + by_deg)
    assert second.handover is None


@pytest.mark.parametrize(
    ("told_deg", "rotation_deg", "rate_deg_s", "by_deg"),
    [(5.0, 5.4, 0.0, 0.4), (5.3, 5.4, 0.0, 0.1), (4.8, 5.1, 0.0, 0.1), (5.3, 5.0, 0.0, 0.0), (5.0, 5.6, 10.0, 0.1)],
)
def test_at_rest_what_fingers_differ_by_is_the_smaller_from_where_it_rested_and_was_told(
    told_deg: float, rotation_deg: float, rate_deg_s: float, by_deg: float
) -> None:
    """At rest at 5 degrees, told last with some noise."""
    before = at_rest(5.0, told_deg=told_deg)
    after = look(before, observation(rotation_deg, rate_deg_s, fingers=("left",)), PARAMS, arm=stands()).detector
    assert after.base_rotation_deg == pytest.approx(5.0 + by_deg)
    assert after.handover == Handover(told_deg, 10.0, 5.0, pytest.approx(by_deg), NOW_S)


def test_both_looks_together_move_no_further_than_all_difference() -> None:
    handed = replace(BEFORE, handed_deg=1.9)
    first = look(handed, observation(7.0, fingers=("left",)), PARAMS).detector
    assert (first.base_rotation_deg, first.handed_deg) == (pytest.approx(4.1), pytest.approx(2.0))
    second = look(first, observation(4.95, fingers=("left",), measured_at_s=NOW_S + 0.01), PARAMS).detector
    assert (second.base_rotation_deg, second.handed_deg) == (pytest.approx(3.95), pytest.approx(1.85))


def test_the_second_look_is_at_another_measurement_of_every_finger() -> None:
    first = look(BEFORE, observation(5.2, fingers=("left",), newest_at_s=NOW_S + 0.01), PARAMS).detector
    for measured_s in (NOW_S + 0.005, NOW_S + 0.01):
        same = look(first, observation(5.0, fingers=("left",), measured_at_s=measured_s), PARAMS).detector
        assert (same.base_rotation_deg, same.handover) == (pytest.approx(4.2), first.handover)


def follow(before: SlipMemory, told: list[tuple[tuple[str, ...], float]]) -> list[SlipAssessment]:
    """Frame after frame at 60 a second, at rest: who tells it, and what."""
    looks: list[SlipAssessment] = []
    for k, (fingers, rotation_deg) in enumerate(told, 1):
        at_s = NOW_S + k / 60.0
        one = observation(rotation_deg, fingers=fingers, captured_at_s=at_s, measured_at_s=at_s, newest_at_s=at_s)
        looks.append(look(before, one, PARAMS, arm=arm(200.0, at_s=at_s)))
        before = looks[-1].detector
    return looks


BOTH, LEFT = ("left", "right"), ("left",)


@pytest.mark.parametrize("slip_deg", [0.7, 0.9, -1.5])
def test_a_finger_that_drops_out_and_returns_hides_no_slip(slip_deg: float) -> None:
    """The object turns as the right finger drops out, and the left one differs by just as much."""
    told = [(BOTH, 5.0), *[(LEFT, 5.0)] * 6, *[(BOTH, 5.0 + slip_deg)] * 3]
    looks = follow(at_rest(5.0), told)
    assert looks[-1].rotation_deg == pytest.approx(abs(slip_deg))
    assert looks[-1].slipping


def test_creep_is_not_swallowed_bit_by_bit_by_a_finger_that_comes_and_goes() -> None:
    told = [(BOTH, 5.0), *[(LEFT, 4.5)] * 6]  # it differs by 0.5
    for k in range(40):
        fingers = BOTH if k // 6 % 2 == 0 else LEFT
        told.append((fingers, 5.0 + 2.0 * k / 60.0 - 0.5 * (fingers == LEFT)))
    looks = follow(at_rest(5.0), told)
    assert any(one.slipping for one in looks)
    assert looks[-1].rotation_deg == pytest.approx(2.0 * 39 / 60.0, abs=0.05)


def test_a_frame_after_a_gap_is_no_second_look() -> None:
    first = look(BEFORE, observation(5.9, fingers=LEFT), PARAMS).detector
    blind = look(first, observation(None), PARAMS).detector
    assert blind.handover is None
    later_s = NOW_S + 0.15
    for before in (first, blind):
        later = observation(4.0, fingers=LEFT, measured_at_s=later_s, captured_at_s=later_s, newest_at_s=later_s)
        after = look(before, later, PARAMS).detector
        assert (after.base_rotation_deg, after.handed_deg, after.handover) == (
            first.base_rotation_deg,
            first.handed_deg,
            None,
        )


def test_a_place_that_these_fingers_have_told_themselves_is_moved_by_no_second_look() -> None:
    lifting = replace(BEFORE, alert=replace(BEFORE.alert, case=MotionCase.LIFT_OFF, rested_deg=None))
    first = look(lifting, observation(6.0, fingers=LEFT), PARAMS, arm=stands()).detector
    assert (first.base_rotation_deg, first.handover) == (6.0, None)
    waits = look(BEFORE, observation(5.2, fingers=LEFT), PARAMS).detector
    assert waits.handover is not None
    assert waits.rebased(rotated=False, slid=False, raised=False).handover is None
    assert look(waits, observation(5.0, fingers=BOTH, measured_at_s=NOW_S + 0.01), PARAMS).detector.handover is None


def test_what_counts_as_another_place() -> None:
    assert not BEFORE.elsewhere(BEFORE)
    assert not replace(BEFORE, base_rotation_deg=4.3, handed_deg=0.4).elsewhere(BEFORE)  # a second look
    assert replace(BEFORE, told_by=LEFT).elsewhere(BEFORE)
    assert not BEFORE.elsewhere(replace(BEFORE, told_by=()))
    assert replace(BEFORE, base_rotation_deg=4.3).elsewhere(BEFORE)
    nowhere = replace(BEFORE, base_rotation_deg=None)
    assert nowhere.elsewhere(BEFORE)
    assert BEFORE.elsewhere(nowhere)
    assert not nowhere.elsewhere(nowhere)


def test_fingers_that_change_again_are_looked_at_anew() -> None:
    first = look(BEFORE, observation(5.2, fingers=("left",)), PARAMS).detector
    again = look(first, observation(5.3, fingers=("right",), measured_at_s=NOW_S + 0.05), PARAMS).detector
    assert dict(again.known) == {BOTH: 0.1, LEFT: pytest.approx(0.3)}
    assert again.handover == Handover(5.2, NOW_S, None, pytest.approx(0.1), NOW_S)
    assert look(SlipMemory(), observation(5.2), PARAMS).detector.handover is None


def test_no_turn_leaves_everything_where_it_is() -> None:
    sight = look(BEFORE, observation(None), PARAMS)
    assert (sight.rotation_deg, sight.rate_deg_s, sight.slip_mm) == (0.0, 0.0, pytest.approx(0.3))
    assert (sight.detector.told_deg, sight.detector.told_s) == (5.0, 10.0)
    assert (sight.detector.told_by, sight.detector.base_rotation_deg) == (BEFORE.told_by, 4.0)
    assert look(BEFORE, observation(shift_mm=None), PARAMS).slip_mm == 0.0
    assert look(replace(BEFORE, base_shift_mm=0.0, smooth_shift_mm=1.3), observation(), PARAMS).slip_mm == 1.3


def test_where_the_arm_comes_to_rest_is_where_turns_and_slides_count_from() -> None:
    lifting = replace(BEFORE, alert=replace(BEFORE.alert, case=MotionCase.LIFT_OFF, rested_deg=None))
    after = look(lifting, observation(), PARAMS, arm=stands()).detector
    assert (after.base_rotation_deg, after.base_shift_mm, after.alert.rested_deg) == (5.0, 1.3, 5.0)
    kept = look(BEFORE, observation(), PARAMS).detector
    assert (kept.base_rotation_deg, kept.base_shift_mm) == (4.0, 1.0)
    first = look(SlipMemory(), observation(), PARAMS).detector
    assert (first.base_rotation_deg, first.base_shift_mm) == (5.0, 1.3)


def test_an_end_of_an_episode_forgets_the_places_and_nothing_else() -> None:
    before = replace(BEFORE, frames=2, far_frames=1)
    assert before.rebased(rotated=False, slid=False, raised=True) == replace(
        before,
        base_rotation_deg=None,
        base_shift_mm=None,
        frames=0,
        alert=replace(before.alert, near_deg=None, rested_deg=None),
    )


def test_a_grip_is_not_firm_and_a_turn_back_no_exception_unless_said_so() -> None:
    lifting = at_rest(0.0, alert=RestingPlace(start_mm=0.0, near_deg=0.0, measured_s=10.0, case=MotionCase.LIFT_OFF))
    rising = arm(10.0, moving=True, at_s=NOW_S)
    assert look(lifting, observation(0.8), PARAMS, arm=rising).rotations
    assert not look(lifting, observation(0.8), PARAMS, arm=rising, firm=True).rotations
    assert look(at_rest(5.0), observation(4.0), PARAMS, arm=stands()).rotations
    assert not look(at_rest(5.0), observation(4.0), PARAMS, arm=stands(), only_outward=True).rotations


@pytest.mark.parametrize(
    ("rotation_deg", "told_deg", "fingers", "frames"),
    [
        (5.39, 5.2, ("left", "right"), 0),
        (5.41, 5.2, ("left", "right"), 1),
        (5.59, 5.2, ("left", "right"), 1),
        (5.61, 5.2, ("left", "right"), 2),
        (4.39, 4.8, ("left", "right"), 2),
        (5.61, 5.09, ("left", "right"), 1),
        (5.61, 5.11, ("left", "right"), 2),
        (5.61, 4.8, ("left", "right"), 1),
        (5.61, 5.2, ("left",), 1),
    ],
)
def test_what_a_sudden_turn_counts_in_a_lift_off(
    rotation_deg: float, told_deg: float, fingers: tuple[str, ...], frames: int
) -> None:
    lifting = RestingPlace(start_mm=0.0, near_deg=5.0, measured_s=10.0, case=MotionCase.LIFT_OFF)
    before = at_rest(5.0, told_deg=told_deg, told_by=fingers, alert=lifting)
    sight = look(before, observation(rotation_deg, fingers=fingers), PARAMS, arm=arm(10.0, moving=True, at_s=NOW_S))
    assert sight.detector.frames == frames
    assert sight.rotations is (frames > 0)
    assert sight.slipping is (frames >= 2)


@pytest.mark.parametrize(
    ("slip_mm", "smooth_mm", "slides"), [(0.5, 0.0, False), (0.51, 0.0, True), (2.0, 2.0, False), (2.01, 2.01, True)]
)
def test_a_slide_counts_beyond_its_level(slip_mm: float, smooth_mm: float, slides: bool) -> None:
    before = replace(BEFORE, base_shift_mm=0.0, smooth_shift_mm=smooth_mm)
    sight = look(before, observation(4.0, shift_mm=slip_mm), PARAMS)
    assert sight.slides is slides
    assert sight.detector.frames == int(slides)
    assert not sight.rotations


@pytest.mark.parametrize(("rotation_deg", "far"), [(45.0, 0), (-45.0, 0), (45.1, 3), (-45.1, 3)])
def test_frames_beyond_the_turn_at_which_it_is_given_up_are_counted(rotation_deg: float, far: int) -> None:
    before = at_rest(rotation_deg, far_frames=2)
    assert look(before, observation(rotation_deg), PARAMS).detector.far_frames == far
    assert look(before, observation(rotation_deg, conflict="the same way"), PARAMS).detector.far_frames == 0
    assert look(at_rest(0.0, far_frames=2), observation(None), PARAMS).detector.far_frames == 0


@pytest.mark.parametrize(("rate_deg_s", "moving"), [(8.0, True), (7.9, False), (-8.0, False)])
def test_it_moves_from_the_rate_of_slip_on(rate_deg_s: float, moving: bool) -> None:
    calm = replace(BEFORE, smooth_shift_mm=1.3)
    assert look(calm, observation(5.0, rate_deg_s), PARAMS).moving is moving


def test_what_has_strayed_counts_from_its_last_rest() -> None:
    strayed = at_rest(5.0, base_rotation_deg=7.2, told_deg=7.2, alert=replace(at_rest(5.0).alert, near_deg=7.2))
    sight = look(strayed, observation(7.2), PARAMS, arm=stands())
    assert (sight.detector.base_rotation_deg, sight.rotation_deg) == (5.0, pytest.approx(2.2))
    assert (sight.rotations, sight.detector.frames) == (True, 1)
    further = look(replace(strayed, base_rotation_deg=4.0), observation(7.2), PARAMS, arm=stands())
    assert further.detector.base_rotation_deg == 4.0
    near = look(replace(strayed, told_deg=6.9), observation(6.9), PARAMS, arm=stands())
    assert (near.detector.base_rotation_deg, near.rotations) == (7.2, False)


def test_after_a_tightening_a_sudden_turn_must_be_twice_as_large() -> None:
    for rotation_deg, counts in ((5.7, 0), (5.75, 1)):
        sight = look(at_rest(5.0, rotations=1), observation(rotation_deg), PARAMS, arm=stands())
        assert sight.detector.frames == counts
    assert look(at_rest(5.0), observation(5.4), PARAMS, arm=stands()).detector.frames == 1


@pytest.mark.parametrize(("rotation_deg", "frames"), [(5.35, 0), (5.37, 1), (4.63, 1), (5.9, 1)])
def test_what_a_sudden_turn_counts_at_rest(rotation_deg: float, frames: int) -> None:
    assert look(at_rest(5.0, told_deg=5.2), observation(rotation_deg), PARAMS, arm=stands()).detector.frames == frames


def test_at_rest_another_frame_counts_if_it_is_later_than_any_flash() -> None:
    first = look(at_rest(5.0), observation(5.6, newest_at_s=NOW_S), PARAMS, arm=stands()).detector
    for later_s, frames in ((0.0195, 1), (0.0205, 2)):
        at_s = NOW_S + later_s
        again = look(
            first, observation(5.6, captured_at_s=at_s, measured_at_s=at_s, newest_at_s=at_s), PARAMS, arm=stands()
        )
        assert again.detector.frames == frames


def test_fingers_that_speak_in_turns_show_a_frame_each_time_both_have_spoken() -> None:
    lifting = RestingPlace(start_mm=0.0, near_deg=5.0, measured_s=10.0, case=MotionCase.LIFT_OFF)
    detector, counted = at_rest(5.0, alert=lifting), []
    for number in range(1, 9):
        at_s = 10.0 + number / 128
        view = observation(5.5, captured_at_s=at_s, measured_at_s=at_s, newest_at_s=at_s + 1 / 128)
        detector = look(detector, view, PARAMS, arm=arm(10.0, moving=True, at_s=at_s)).detector
        counted.append(detector.frames)
    assert counted == [1, 1, 2, 2, 3, 3, 4, 4]


def test_a_turn_all_the_way_back_is_neither_slip_nor_an_error() -> None:
    for rotation_deg in (0.0, -0.5):
        rested = replace(at_rest(5.0).alert, near_deg=rotation_deg)
        back = at_rest(5.0, base_rotation_deg=rotation_deg, told_deg=rotation_deg, alert=rested)
        assert not look(back, observation(rotation_deg), PARAMS, arm=stands()).rotations
        put_down = look(
            replace(BEFORE, told_deg=rotation_deg), observation(rotation_deg, -30.0), PARAMS, only_outward=True
        )
        assert (put_down.rotations, put_down.rate_deg_s, put_down.rotation_deg) == (False, 0.0, 4.0 - rotation_deg)
    beyond = look(replace(BEFORE, told_deg=-4.1), observation(-4.1, -30.0), PARAMS, only_outward=True)
    assert (beyond.rotations, beyond.rate_deg_s) == (True, 30.0)


def test_creep_too_must_be_larger_after_a_tightening() -> None:
    for rotations, rotation_deg, creeps in ((0, 10.0, False), (0, 10.1, True), (1, 15.9, False), (1, 16.1, True)):
        before = replace(BEFORE, rotations=rotations, told_deg=rotation_deg)
        assert look(before, observation(rotation_deg, 1.0), PARAMS).rotations is creeps
