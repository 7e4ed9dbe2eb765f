"""Single assessments: every field of memory and result, at and next to the limits."""

from __future__ import annotations

import math

import pytest
from observations import arm, fused
from records import changed, slip_memory

from slipguard.control.finger_fusion import FusedEstimate
from slipguard.control.needed_force import ElasticMotion
from slipguard.control.params import GuardParams
from slipguard.control.slip_baselines import FingerSwitch
from slipguard.control.slip_detector import SlipAssessment, assess_slip
from slipguard.control.slip_memory import ArmCase, SlipMemory
from slipguard.devices import ArmState

PARAMS = GuardParams()
NOW_S = 10.05
BEFORE = slip_memory(
    episode_deg=4.0, episode_mm=1.0, measured_s=10.0, captured_s=10.0, rotations=0,
    names=("left", "right"), last_deg=5.0, last_s=10.0, total_deg=0.1, smooth_mm=1.2,
    rate_mm_s=2.0, settled_deg=4.9, settled_mm=1.1, settled_since_s=9.0,
    start_mm=0.0, resting_deg=4.5, previous_deg=4.6, before_motion_deg=4.4, followed_s=10.0,
)  # fmt: skip
"""The arm moves, or it is unknown."""


def observation(rotation_deg: float | None = 5.0, rate_deg_s: float | None = 0.0, **changes: object) -> FusedEstimate:
    given = fused(rotation_deg, rate_deg_s, at_s=NOW_S, shift_mm=1.3, sigma_deg=0.1)
    return changed(given, **{"newest_at_s": NOW_S, **changes})  # type: ignore[arg-type]


def at_rest(rotation_deg: float = 5.0, **changes: object) -> SlipMemory:
    """At rest in the air for a while, at that rotation."""
    same = dict.fromkeys(
        ("episode_deg", "last_deg", "settled_deg", "resting_deg", "previous_deg", "before_motion_deg"), rotation_deg
    )
    return changed(BEFORE, **({**same, "case": ArmCase.REST, "aloft": True} | changes))


def stands(height_mm: float = 200.0) -> ArmState:
    return arm(height_mm, at_s=NOW_S)


def test_a_change_of_finger_moves_every_place_that_is_remembered() -> None:
    """0.8 degrees further, of which the object has rotated 0.6; 0.3 mm, of which it has moved 0.1."""
    before = changed(BEFORE, shift_fingers=("left", "right"))
    seen = observation(5.8, 12.0, fingers=("left",), shift_mm=1.5, shift_fingers=("left",))
    sight = assess_slip(before, seen, PARAMS)
    smooth_mm = 1.4 + (1.0 - math.exp(-1.0)) * 0.1
    rate_mm_s = (1.5 - smooth_mm) / 0.05
    assert sight == SlipAssessment(
        memory=slip_memory(
            episode_deg=pytest.approx(4.2),
            episode_mm=pytest.approx(1.2),
            measured_s=NOW_S,
            captured_s=NOW_S,
            names=("left",),
            last_deg=5.8,
            last_s=NOW_S,
            total_deg=pytest.approx(0.3),
            known=((("left", "right"), 0.1),),
            shift_fingers=("left",),
            switched_mm=(pytest.approx(0.2), 0.0),
            unloaded_deg=pytest.approx(0.2),
            unloaded_mm=(pytest.approx(0.2), 0.0),
            switch=FingerSwitch(5.0, 10.0, None, pytest.approx(0.2), NOW_S),
            smooth_mm=pytest.approx(smooth_mm),
            rate_mm_s=pytest.approx(rate_mm_s),
            settled_deg=pytest.approx(5.1),
            settled_mm=pytest.approx(1.3),
            settled_since_s=9.0,
            start_mm=0.0,
            resting_deg=pytest.approx(4.7),
            previous_deg=pytest.approx(4.8),
            before_motion_deg=pytest.approx(4.6),
            followed_s=NOW_S,
        ),
        rotation_deg=pytest.approx(1.6),
        rate_deg_s=12.0,
        slip_mm=pytest.approx(0.3),
        slip_rate_mm_s=pytest.approx(rate_mm_s),
        moving=True,
        settled_s=pytest.approx(NOW_S - 9.0),
    )


def test_the_same_estimate_again_is_the_same_frame() -> None:
    before = changed(BEFORE, measured_s=NOW_S, frames=1, far_frames=1)
    after = assess_slip(before, observation(5.8, 12.0, fingers=("left",), shift_mm=1.5), PARAMS).memory
    assert (after.fingers.last_deg, after.fingers.last_s) == (pytest.approx(5.2), 10.0)
    assert (after.frames, after.far_frames, after.measured_s) == (1, 1, NOW_S)


def test_a_finger_without_rate_or_shift_is_taken_as_it_is() -> None:
    after = assess_slip(BEFORE, observation(5.3, None, fingers=("right",), shift_mm=None), PARAMS).memory
    assert (after.baselines.episode_deg, after.fingers.total_deg) == (pytest.approx(4.3), pytest.approx(0.4))
    assert (after.baselines.episode_mm, after.shift.smooth_mm, after.shift.rate_mm_s) == (1.0, 1.2, 0.0)


@pytest.mark.parametrize(
    ("rotation_deg", "rate_deg_s", "by_deg"),
    [(5.05, 0.0, 0.05), (5.5, 0.0, 0.2), (4.9, 0.0, -0.1), (4.7, 0.0, 0.2), (6.25, 12.0, 0.05)],
)
def test_the_offset_between_fingers_is_the_smaller_of_two_frames(
    rotation_deg: float, rate_deg_s: float, by_deg: float
) -> None:
    """The first frame said 0.2; by the second's rate the object may have rotated since."""
    first = assess_slip(BEFORE, observation(5.2, fingers=("left",)), PARAMS).memory
    again = observation(
        rotation_deg, rate_deg_s, fingers=("left",), captured_at_s=NOW_S + 0.05, measured_at_s=NOW_S + 0.05
    )
    second = assess_slip(first, again, PARAMS).memory
    assert (second.baselines.episode_deg, second.fingers.total_deg) == (
        pytest.approx(4.0 + by_deg),
        pytest.approx(0.1 + by_deg),
    )
    assert second.baselines.before_motion_deg == pytest.approx(4.4 + by_deg)
    assert second.fingers.switch is None


@pytest.mark.parametrize(
    ("estimated_deg", "rotation_deg", "rate_deg_s", "by_deg"),
    [(5.0, 5.4, 0.0, 0.4), (5.3, 5.4, 0.0, 0.1), (4.8, 5.1, 0.0, 0.1), (5.3, 5.0, 0.0, 0.0), (5.0, 5.6, 10.0, 0.1)],
)
def test_at_rest_the_offset_is_the_smaller_from_resting_angle_and_last_estimate(
    estimated_deg: float, rotation_deg: float, rate_deg_s: float, by_deg: float
) -> None:
    """At rest at 5 degrees, given last with some noise."""
    before = at_rest(5.0, last_deg=estimated_deg)
    after = assess_slip(before, observation(rotation_deg, rate_deg_s, fingers=("left",)), PARAMS, arm=stands()).memory
    assert after.baselines.episode_deg == pytest.approx(5.0 + by_deg)
    assert after.fingers.switch == FingerSwitch(estimated_deg, 10.0, 5.0, pytest.approx(by_deg), NOW_S)


def test_both_frames_together_move_no_further_than_the_largest_offset() -> None:
    handed = changed(BEFORE, total_deg=1.9)
    first = assess_slip(handed, observation(7.0, fingers=("left",)), PARAMS).memory
    assert (first.baselines.episode_deg, first.fingers.total_deg) == (pytest.approx(4.1), pytest.approx(2.0))
    second = assess_slip(first, observation(4.95, fingers=("left",), measured_at_s=NOW_S + 0.01), PARAMS).memory
    assert (second.baselines.episode_deg, second.fingers.total_deg) == (pytest.approx(3.95), pytest.approx(1.85))


def test_the_second_frame_is_a_new_measurement_of_every_finger() -> None:
    first = assess_slip(BEFORE, observation(5.2, fingers=("left",), newest_at_s=NOW_S + 0.01), PARAMS).memory
    for measured_s in (NOW_S + 0.005, NOW_S + 0.01):
        same = assess_slip(first, observation(5.0, fingers=("left",), measured_at_s=measured_s), PARAMS).memory
        assert (same.baselines.episode_deg, same.fingers.switch) == (pytest.approx(4.2), first.fingers.switch)


def follow(before: SlipMemory, given: list[tuple[tuple[str, ...], float]]) -> list[SlipAssessment]:
    """Assess frame after frame at 60 per second, at rest, from these fingers and rotations."""
    looks: list[SlipAssessment] = []
    for k, (fingers, rotation_deg) in enumerate(given, 1):
        at_s = NOW_S + k / 60.0
        one = observation(rotation_deg, fingers=fingers, captured_at_s=at_s, measured_at_s=at_s, newest_at_s=at_s)
        looks.append(assess_slip(before, one, PARAMS, arm=arm(200.0, at_s=at_s)))
        before = looks[-1].memory
    return looks


BOTH, LEFT = ("left", "right"), ("left",)


@pytest.mark.parametrize("slip_deg", [0.7, 0.9, -1.5])
def test_a_finger_that_drops_out_and_returns_hides_no_slip(slip_deg: float) -> None:
    """The object rotates as the right finger drops out, and the left one differs by just as much."""
    given = [(BOTH, 5.0), *[(LEFT, 5.0)] * 6, *[(BOTH, 5.0 + slip_deg)] * 3]
    looks = follow(at_rest(5.0), given)
    assert looks[-1].rotation_deg == pytest.approx(abs(slip_deg))
    assert looks[-1].slipping


def test_creep_is_not_swallowed_bit_by_bit_by_a_finger_that_comes_and_goes() -> None:
    given = [(BOTH, 5.0), *[(LEFT, 4.5)] * 6]  # it differs by 0.5
    for k in range(40):
        fingers = BOTH if k // 6 % 2 == 0 else LEFT
        given.append((fingers, 5.0 + 2.0 * k / 60.0 - 0.5 * (fingers == LEFT)))
    looks = follow(at_rest(5.0), given)
    assert any(one.slipping for one in looks)
    assert looks[-1].rotation_deg == pytest.approx(2.0 * 39 / 60.0, abs=0.05)


def test_a_frame_after_a_gap_does_not_confirm_the_offset() -> None:
    first = assess_slip(BEFORE, observation(5.9, fingers=LEFT), PARAMS).memory
    without_estimate = assess_slip(first, observation(None), PARAMS).memory
    assert without_estimate.fingers.switch is None
    later_s = NOW_S + 0.15
    for before in (first, without_estimate):
        later = observation(4.0, fingers=LEFT, measured_at_s=later_s, captured_at_s=later_s, newest_at_s=later_s)
        after = assess_slip(before, later, PARAMS).memory
        assert (after.baselines.episode_deg, after.fingers.total_deg, after.fingers.switch) == (
            first.baselines.episode_deg,
            first.fingers.total_deg,
            None,
        )


def test_a_baseline_of_these_fingers_is_not_moved_by_the_second_frame() -> None:
    lifting = changed(BEFORE, case=ArmCase.LIFT_OFF, before_motion_deg=None)
    first = assess_slip(lifting, observation(6.0, fingers=LEFT), PARAMS, arm=stands()).memory
    assert (first.baselines.episode_deg, first.fingers.switch) == (6.0, None)
    waits = assess_slip(BEFORE, observation(5.2, fingers=LEFT), PARAMS).memory
    assert waits.fingers.switch is not None
    assert waits.after_episode(rotated=False, raised=False).fingers.switch is None
    assert (
        assess_slip(waits, observation(5.0, fingers=BOTH, measured_at_s=NOW_S + 0.01), PARAMS).memory.fingers.switch
        is None
    )


def test_what_counts_as_another_place() -> None:
    assert not BEFORE.baseline_changed(BEFORE)
    assert not changed(BEFORE, episode_deg=4.3, total_deg=0.4).baseline_changed(BEFORE)  # a second look
    assert changed(BEFORE, names=LEFT).baseline_changed(BEFORE)
    assert not BEFORE.baseline_changed(changed(BEFORE, names=()))
    assert changed(BEFORE, episode_deg=4.3).baseline_changed(BEFORE)
    nowhere = changed(BEFORE, episode_deg=None)
    assert nowhere.baseline_changed(BEFORE)
    assert BEFORE.baseline_changed(nowhere)
    assert not nowhere.baseline_changed(nowhere)


def test_after_another_switch_the_offset_is_measured_again() -> None:
    first = assess_slip(BEFORE, observation(5.2, fingers=("left",)), PARAMS).memory
    again = assess_slip(first, observation(5.3, fingers=("right",), measured_at_s=NOW_S + 0.05), PARAMS).memory
    assert dict(again.fingers.known) == {BOTH: 0.1, LEFT: pytest.approx(0.3)}
    assert again.fingers.switch == FingerSwitch(5.2, NOW_S, None, pytest.approx(0.1), NOW_S)
    assert assess_slip(SlipMemory(), observation(5.2), PARAMS).memory.fingers.switch is None


def test_without_a_rotation_every_baseline_stays() -> None:
    sight = assess_slip(BEFORE, observation(None), PARAMS)
    assert (sight.rotation_deg, sight.rate_deg_s, sight.slip_mm) == (0.0, 0.0, pytest.approx(0.3))
    assert (sight.memory.fingers.last_deg, sight.memory.fingers.last_s) == (5.0, 10.0)
    assert (sight.memory.fingers.names, sight.memory.baselines.episode_deg) == (BEFORE.fingers.names, 4.0)
    assert assess_slip(BEFORE, observation(shift_mm=None), PARAMS).slip_mm == 0.0
    assert assess_slip(changed(BEFORE, episode_mm=0.0, smooth_mm=1.3), observation(), PARAMS).slip_mm == 1.3


def test_motion_counts_from_where_the_arm_comes_to_rest() -> None:
    lifting = changed(BEFORE, case=ArmCase.LIFT_OFF, before_motion_deg=None)
    after = assess_slip(lifting, observation(), PARAMS, arm=stands()).memory
    assert (after.baselines.episode_deg, after.baselines.episode_mm, after.baselines.before_motion_deg) == (
        5.0,
        1.3,
        5.0,
    )
    kept = assess_slip(BEFORE, observation(), PARAMS).memory
    assert (kept.baselines.episode_deg, kept.baselines.episode_mm) == (4.0, 1.0)
    first = assess_slip(SlipMemory(), observation(), PARAMS).memory
    assert (first.baselines.episode_deg, first.baselines.episode_mm) == (5.0, 1.3)


def test_an_end_of_an_episode_forgets_the_places_and_nothing_else() -> None:
    before = changed(BEFORE, frames=2, far_frames=1)
    assert before.after_episode(rotated=False, raised=True) == changed(
        before,
        episode_deg=None,
        episode_mm=None,
        frames=0,
        resting_deg=None,
        before_motion_deg=None,
        unloaded_deg=None,
        unloaded_mm=None,
        had_slip=True,
    )


def test_by_default_no_torsion_is_borne_and_rotation_back_is_slip() -> None:
    lifting = at_rest(0.0, start_mm=0.0, resting_deg=0.0, followed_s=10.0, case=ArmCase.LIFT_OFF, aloft=False)
    rising = arm(10.0, moving=True, at_s=NOW_S)
    assert assess_slip(lifting, observation(0.8), PARAMS, arm=rising).rotates
    assert not assess_slip(lifting, observation(0.8), PARAMS, arm=rising, elastic_limit=ElasticMotion(1.0, 9.0)).rotates
    assert assess_slip(at_rest(5.0), observation(4.0), PARAMS, arm=stands()).rotates
    assert not assess_slip(at_rest(5.0), observation(4.0), PARAMS, arm=stands(), only_outward=True).rotates


@pytest.mark.parametrize(
    ("rotation_deg", "estimated_deg", "fingers", "frames"),
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
def test_how_many_frames_a_sudden_rotation_counts_in_a_lift_off(
    rotation_deg: float, estimated_deg: float, fingers: tuple[str, ...], frames: int
) -> None:
    lifting = {"case": ArmCase.LIFT_OFF, "aloft": False, "previous_deg": None, "before_motion_deg": None}
    before = at_rest(5.0, last_deg=estimated_deg, names=fingers, **lifting)
    sight = assess_slip(
        before, observation(rotation_deg, fingers=fingers), PARAMS, arm=arm(10.0, moving=True, at_s=NOW_S)
    )
    assert sight.memory.frames == frames
    assert sight.rotates is (frames > 0)
    assert sight.slipping is (frames >= 2)


@pytest.mark.parametrize(
    ("slip_mm", "smooth_mm", "translates"),
    [(0.25, -0.2, False), (0.26, -0.2, True), (0.26, 0.0, False), (2.0, 2.0, False), (2.01, 2.01, True)],
)
def test_translation_counts_beyond_its_threshold(slip_mm: float, smooth_mm: float, translates: bool) -> None:
    """Half of `slip_mm` in a gel that bears nothing, if it is fast; a slow one from `creep_mm` on."""
    before = changed(BEFORE, episode_mm=0.0, smooth_mm=smooth_mm)
    sight = assess_slip(before, observation(4.0, shift_mm=slip_mm), PARAMS)
    assert sight.translates is translates
    assert sight.memory.frames == int(translates)
    assert not sight.rotates


@pytest.mark.parametrize(("rotation_deg", "far"), [(45.0, 0), (-45.0, 0), (45.1, 3), (-45.1, 3)])
def test_frames_beyond_the_largest_rotation_are_counted(rotation_deg: float, far: int) -> None:
    before = at_rest(rotation_deg, far_frames=2)
    assert assess_slip(before, observation(rotation_deg), PARAMS).memory.far_frames == far
    assert assess_slip(before, observation(rotation_deg, conflict="the same way"), PARAMS).memory.far_frames == 0
    assert assess_slip(at_rest(0.0, far_frames=2), observation(None), PARAMS).memory.far_frames == 0


@pytest.mark.parametrize(("rate_deg_s", "moving"), [(8.0, True), (7.9, False), (-8.0, False)])
def test_it_moves_from_the_rate_of_slip_on(rate_deg_s: float, moving: bool) -> None:
    settled = changed(BEFORE, smooth_mm=1.3)
    assert assess_slip(settled, observation(5.0, rate_deg_s), PARAMS).moving is moving


def test_an_object_that_rests_further_out_counts_from_its_last_rest() -> None:
    strayed = at_rest(5.0, episode_deg=7.2, last_deg=7.2, resting_deg=7.2)
    sight = assess_slip(strayed, observation(7.2), PARAMS, arm=stands())
    assert (sight.memory.baselines.episode_deg, sight.rotation_deg) == (5.0, pytest.approx(2.2))
    assert (sight.rotates, sight.memory.frames) == (True, 1)
    further = assess_slip(changed(strayed, episode_deg=4.0), observation(7.2), PARAMS, arm=stands())
    assert further.memory.baselines.episode_deg == 4.0
    near = assess_slip(changed(strayed, last_deg=6.9), observation(6.9), PARAMS, arm=stands())
    assert (near.memory.baselines.episode_deg, near.rotates) == (7.2, False)


def test_after_a_tightening_a_sudden_rotation_must_be_twice_as_large() -> None:
    for rotation_deg, counts in ((5.7, 0), (5.75, 1)):
        sight = assess_slip(at_rest(5.0, rotations=1), observation(rotation_deg), PARAMS, arm=stands())
        assert sight.memory.frames == counts
    assert assess_slip(at_rest(5.0), observation(5.4), PARAMS, arm=stands()).memory.frames == 1


@pytest.mark.parametrize(("rotation_deg", "frames"), [(5.35, 0), (5.37, 1), (4.63, 1), (5.9, 1)])
def test_how_many_frames_a_sudden_rotation_counts_at_rest(rotation_deg: float, frames: int) -> None:
    assert (
        assess_slip(at_rest(5.0, last_deg=5.2), observation(rotation_deg), PARAMS, arm=stands()).memory.frames == frames
    )


def test_at_rest_another_frame_counts_if_it_is_later_than_any_flash() -> None:
    first = assess_slip(at_rest(5.0), observation(5.6, newest_at_s=NOW_S), PARAMS, arm=stands()).memory
    for later_s, frames in ((0.0195, 1), (0.0205, 2)):
        at_s = NOW_S + later_s
        again = assess_slip(
            first, observation(5.6, captured_at_s=at_s, measured_at_s=at_s, newest_at_s=at_s), PARAMS, arm=stands()
        )
        assert again.memory.frames == frames


def test_fingers_measured_alternately_count_a_frame_when_both_are_new() -> None:
    lifting = {"case": ArmCase.LIFT_OFF, "aloft": False, "previous_deg": None, "before_motion_deg": None}
    memory, counted = at_rest(5.0, **lifting), []
    for number in range(1, 9):
        at_s = 10.0 + number / 128
        view = observation(5.5, captured_at_s=at_s, measured_at_s=at_s, newest_at_s=at_s + 1 / 128)
        memory = assess_slip(memory, view, PARAMS, arm=arm(10.0, moving=True, at_s=at_s)).memory
        counted.append(memory.frames)
    assert counted == [1, 1, 2, 2, 3, 3, 4, 4]


def test_rotation_all_the_way_back_is_neither_slip_nor_an_error() -> None:
    for rotation_deg in (0.0, -0.5):
        back = at_rest(5.0, episode_deg=rotation_deg, last_deg=rotation_deg, resting_deg=rotation_deg)
        assert not assess_slip(back, observation(rotation_deg), PARAMS, arm=stands()).rotates
        put_down = assess_slip(
            changed(BEFORE, last_deg=rotation_deg), observation(rotation_deg, -30.0), PARAMS, only_outward=True
        )
        assert (put_down.rotates, put_down.rate_deg_s, put_down.rotation_deg) == (False, 0.0, 0.0)
    beyond = assess_slip(changed(BEFORE, last_deg=-4.1), observation(-4.1, -30.0), PARAMS, only_outward=True)
    assert (beyond.rotates, beyond.rate_deg_s) == (True, 30.0)


def test_creep_too_must_be_larger_after_a_tightening() -> None:
    for rotations, rotation_deg, creeps in ((0, 10.0, False), (0, 10.1, True), (1, 15.9, False), (1, 16.1, True)):
        before = changed(BEFORE, rotations=rotations, last_deg=rotation_deg)
        assert assess_slip(before, observation(rotation_deg, 1.0), PARAMS).rotates is creeps


@pytest.mark.parametrize(("motion_known", "case"), [(True, ArmCase.REST), (False, ArmCase.MOVING)])
def test_an_arm_whose_motion_is_unknown_is_judged_as_moving(motion_known: bool, case: ArmCase) -> None:
    state = ArmState(0.0, 0.0, False, False, False, NOW_S, motion_known=motion_known)
    assert assess_slip(at_rest(), observation(), PARAMS, arm=state).memory.arm.case is case


def test_a_slide_by_an_unknown_distance_is_slip() -> None:
    slides = observation(shift_mm=None, slides=True)
    seen = assess_slip(BEFORE, slides, PARAMS)
    assert seen.translates
    assert seen.moving
    assert seen.memory.frames == 1
    assert seen.what == "rotated 1.0° at 0°/s, slides by an unknown distance"
    assert not assess_slip(BEFORE, slides, PARAMS, only_outward=True).translates
