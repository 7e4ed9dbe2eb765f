"""How little counts as slip, in sequences of frames: at rest in the air, lifting off, in motion."""

from __future__ import annotations

import numpy as np
import pytest
from observations import arm, fused
from records import changed, slip_memory

from slipguard.control.needed_force import UNKNOWN_MAX_DEG, UNKNOWN_MAX_MM, ElasticMotion
from slipguard.control.params import GuardParams
from slipguard.control.slip_baselines import SWITCH_MAX_DEG, SWITCH_SHIFT_MM, ShiftFilter
from slipguard.control.slip_detector import NO_MOTION, SlipAssessment, assess_slip, growth, threshold_deg
from slipguard.control.slip_memory import ARM_SETTLE_S, LIFT_OFF_MM, NOISE_MAX_DEG, NOISE_TIMES, ArmCase, SlipMemory

PARAMS = GuardParams()
FRAME_S = 1 / 60


class Watched:
    """Frames one after the other, with the arm as it is."""

    def __init__(self, had_rotation: bool = False, params: GuardParams = PARAMS) -> None:
        self.memory, self.params = slip_memory(had_rotation=had_rotation), params
        self.left_alone = False
        self.elastic_limit = NO_MOTION
        self.now_s, self.here = 10.0, arm()
        self.rate_deg_s, self.shift_mm = 0.0, 0.0
        self.putting_down = False
        self.conflict: str | None = None
        self.shift_conflict: str | None = None

    def see(self, rotation_deg: float, *, sigma_deg: float = 0.05) -> SlipAssessment:
        self.now_s += FRAME_S
        fingers = ("left",) if self.left_alone else ("left", "right")
        view = fused(
            rotation_deg, self.rate_deg_s, at_s=self.now_s, sigma_deg=sigma_deg, fingers=fingers,
            shift_mm=self.shift_mm,
            conflict=self.conflict,
        )  # fmt: skip
        view = changed(view, shift_conflict=self.shift_conflict)
        here = changed(self.here, measured_at_s=self.now_s)
        sight = assess_slip(
            self.memory, view, self.params, arm=here, elastic_limit=self.elastic_limit, only_outward=self.putting_down
        )
        self.memory = sight.memory
        return sight

    def rest(self, seconds: float = 0.5, rotation_deg: float = 0.0) -> Watched:
        for _ in range(round(seconds / FRAME_S)):
            assert not self.see(rotation_deg).slipping
        return self

    def lifts(self, height_mm: float) -> Watched:
        self.here = arm(height_mm, moving=True)
        return self


def test_plain_slip_at_rest_takes_two_frames() -> None:
    watched = Watched().rest()
    watched.see(0.1)
    assert not watched.see(3.0).slipping
    assert watched.see(3.0).slipping


def test_plain_slip_in_a_lift_off_takes_one_frame_if_the_one_before_had_begun_it() -> None:
    begun = Watched().rest().lifts(10.0)
    assert not begun.see(0.15).slipping
    assert begun.see(0.7).slipping
    leaps = Watched().rest().lifts(10.0)
    assert not leaps.see(0.7).slipping
    assert leaps.see(0.7).slipping
    one = Watched()
    one.left_alone = True
    one.rest().lifts(10.0).see(0.15)
    assert not one.see(0.7).slipping
    assert one.see(0.7).slipping


def test_the_resting_angle_is_taken_from_a_steady_frame() -> None:
    """One leaping frame at the end of the arm's motion is no place to rotation away from."""
    watched = aloft(10.0)
    watched.lifts(130.0).see(10.0)
    watched.here = arm(130.0)
    while watched.now_s + FRAME_S < watched.memory.arm.moved_s + ARM_SETTLE_S:
        watched.see(10.0)
    watched.rate_deg_s = -6.0
    watched.see(9.4)
    assert watched.memory.arm.case is ArmCase.REST
    assert watched.memory.baselines.resting_deg is None
    watched.rate_deg_s = 0.0
    assert not any(watched.see(10.0).slipping for _ in range(5))
    assert watched.memory.baselines.resting_deg == 10.0


@pytest.mark.parametrize("leap_deg", [0.6, -0.6, 3.0])
def test_a_single_frame_that_leaps_in_both_fingers_is_no_slip(leap_deg: float) -> None:
    for height_mm in (None, 10.0):
        watched = Watched().rest()
        if height_mm is not None:
            watched.lifts(height_mm)
        assert not watched.see(leap_deg).slipping
        assert not any(watched.see(0.0).slipping for _ in range(10))


def test_a_little_above_the_level_takes_two_frames() -> None:
    watched = Watched().rest()
    assert not watched.see(-0.4).slipping
    assert watched.see(-0.4).slipping
    flickers = Watched().rest()
    assert not any(flickers.see(rotation).slipping for rotation in (0.4, 0.0, 0.4, 0.0, 0.4))


def test_an_uncertain_rotation_needs_three_sigmas_or_half_of_that_in_a_lift_off() -> None:
    for watched, least_deg in ((Watched().rest(), 1.8), (Watched().rest().lifts(10.0), 0.9)):
        assert not any(watched.see(least_deg - 0.05, sigma_deg=0.6).slipping for _ in range(5))
        watched.see(least_deg + 0.05, sigma_deg=0.6)
        assert watched.see(least_deg + 0.05, sigma_deg=0.6).slipping
    assert not any(Watched().rest().see(1.5, sigma_deg=6.0).slipping for _ in range(5))


def test_the_level_follows_the_sensors_own_noise() -> None:
    rng = np.random.default_rng(0)
    watched = Watched()
    for _ in range(600):
        assert not watched.see(float(rng.normal(0.0, 0.2)), sigma_deg=0.2).slipping
    assert 0.15 < watched.memory.noise_deg2**0.5 < 0.3
    assert 1.0 < watched.memory.quick_threshold_deg(ArmCase.REST, PARAMS) < 1.6
    assert SlipMemory().quick_threshold_deg(ArmCase.REST, PARAMS) == pytest.approx(0.36)
    quiet, noisy = SlipMemory(noise_deg2=1e-6), SlipMemory(noise_deg2=100.0)
    assert quiet.quick_threshold_deg(ArmCase.REST, PARAMS) == PARAMS.tuning.tighten_at_rest_deg
    assert noisy.quick_threshold_deg(ArmCase.REST, PARAMS) == NOISE_TIMES * NOISE_MAX_DEG


@pytest.mark.parametrize("rate_deg_s", [0.3, 1.0, 3.0, 6.0, 12.0])
@pytest.mark.parametrize("noise_deg", [0.0, 0.03])
def test_slow_slip_at_rest_does_not_pass_for_the_sensors_noise(rate_deg_s: float, noise_deg: float) -> None:
    rng = np.random.default_rng(1)
    watched = Watched()
    for _ in range(120):
        watched.see(float(rng.normal(0.0, noise_deg)))
    watched.rate_deg_s = min(rate_deg_s, PARAMS.tuning.slip_rate_deg_s - 1.0)
    rotations = [rate_deg_s * k * FRAME_S for k in range(1, 300)]
    found = next(
        rotation for rotation in rotations if watched.see(rotation + float(rng.normal(0.0, noise_deg))).slipping
    )
    assert PARAMS.tuning.tighten_at_rest_deg < found < 0.8


def test_a_drift_is_followed() -> None:
    watched = Watched()
    for k in range(60 * 60):
        assert not watched.see(0.05 * k * FRAME_S).slipping


def test_an_object_twisted_by_the_lift_counts_from_where_it_came_to_rest() -> None:
    watched = Watched(had_rotation=True).rest().lifts(10.0)
    watched.rate_deg_s = 5.0
    for k in range(40):
        watched.here = arm(2.4 * k, moving=True)
        assert not watched.see(0.14 * k).slipping
    watched.here = arm(120.0)
    watched.rate_deg_s = 0.0
    watched.rest(2.0, 10.0)
    assert watched.memory.baselines.episode_deg == 10.0
    watched.see(10.6)
    assert watched.see(10.6).slipping


def test_no_grip_is_given_that_time_before_it_has_been_tightened_once() -> None:
    for elastic_deg, least_deg in ((0.0, 0.4), (1.0, 1.0)):
        watched = Watched().rest().lifts(10.0)
        watched.elastic_limit = ElasticMotion(elastic_deg, elastic_deg)
        assert not any(watched.see(least_deg - 0.05).slipping for _ in range(3))
        watched.see(least_deg + 0.05)
        assert watched.see(least_deg + 0.05).slipping


@pytest.mark.parametrize(
    ("had_slip", "lifts", "rotation_deg", "shift_mm", "slips"),
    [
        (False, True, 0.9, 0.0, False),
        (False, True, 1.1, 0.0, True),
        (False, True, 0.9, 0.5, True),
        (True, True, 0.3, 0.0, False),
        (True, True, 0.9, 0.0, True),
        (True, False, 0.9, 0.0, False),
        (True, False, 1.1, 0.0, True),
    ],
)
def test_what_a_grip_bears_is_no_slip_and_after_a_slip_in_the_lift_it_bears_less(
    had_slip: bool, lifts: bool, rotation_deg: float, shift_mm: float, slips: bool
) -> None:
    """Inside of an ellipse of rotation and shift."""
    watched = Watched()
    watched.elastic_limit = ElasticMotion(1.0, 1.0)
    watched.memory = changed(watched.memory, had_slip=had_slip)
    watched.rest()
    if lifts:
        watched.lifts(10.0)
    watched.shift_mm = shift_mm
    watched.see(0.5 * rotation_deg)
    watched.see(rotation_deg)
    assert watched.see(rotation_deg).slipping is slips


def test_an_object_hangs_once_the_arm_rises_without_rotating_it() -> None:
    watched = Watched().rest().lifts(0.0)
    for height_mm in range(60):  # its far end is on the table until 29 mm
        watched.here = arm(float(height_mm), moving=True)
        watched.see(0.1 * min(height_mm, 30))
        assert watched.memory.arm.hangs is (height_mm >= 41)
    watched.putting_down = True
    watched.see(3.0)
    assert not watched.memory.arm.hangs


def test_without_a_rotation_or_an_arm_it_is_unknown_whether_it_hangs() -> None:
    watched = Watched().rest().lifts(0.0)
    view = fused(None, at_s=20.0, declined="round contact")
    for here in (arm(50.0, moving=True), None):
        assert not assess_slip(watched.memory, view, PARAMS, arm=here).memory.arm.hangs


def test_a_fast_rotation_in_a_lift_off_is_answered_before_it_is_large() -> None:
    """40 degrees/s: the next 0.1 s count. An arm that rotates it slowly may go on."""
    for rate_deg_s, slips in ((40.0, True), (5.0, False)):
        watched = Watched(had_rotation=True).rest().lifts(10.0)
        watched.rate_deg_s = rate_deg_s
        watched.see(3.0)
        assert watched.see(3.2).slipping is slips


def test_after_a_tightening_a_lift_goes_on_with_more_patience() -> None:
    watched = Watched().rest().lifts(10.0)
    watched.memory = watched.memory.after_episode(rotated=True, raised=True)
    assert not any(watched.see(0.2 * k).slipping for k in range(31))
    assert not watched.see(6.1).slipping
    assert watched.see(6.3).slipping


@pytest.mark.parametrize(("wound_deg", "swing_deg", "slips"), [(8.0, 3.5, False), (8.0, 4.5, True), (0.0, 2.5, True)])
def test_the_swing_allowed_in_motion_depends_on_the_elastic_torsion(
    wound_deg: float, swing_deg: float, slips: bool
) -> None:
    watched = Watched(had_rotation=True)
    watched.rest(0.1)
    watched.here = arm(LIFT_OFF_MM + 50.0)
    watched.memory = changed(
        watched.memory,
        **dict.fromkeys(("episode_deg", "resting_deg", "previous_deg", "before_motion_deg"), None),
        start_mm=0.0,
        moved_s=float("-inf"),
        case=ArmCase.MOVING,
        aloft=True,
    )
    for _ in range(60):
        watched.see(wound_deg)
    watched.here = arm(LIFT_OFF_MM + 50.0, moving=True)
    watched.rate_deg_s = 60.0
    assert any(watched.see(wound_deg + swing_deg).slipping for _ in range(2)) is slips


def test_the_gel_is_given_time_to_settle_after_the_arm_has_stopped() -> None:
    watched = Watched().rest().lifts(LIFT_OFF_MM + 20.0)
    watched.see(0.0)
    watched.here = arm(LIFT_OFF_MM + 20.0)
    stopped_s = watched.now_s
    for k in range(round((ARM_SETTLE_S - 0.02) / FRAME_S)):
        assert not watched.see(0.8 * (-1) ** k).slipping
    watched.see(0.0)
    while watched.now_s < stopped_s + ARM_SETTLE_S + 0.2:
        watched.see(0.0)
    assert watched.memory.arm.case is ArmCase.REST
    watched.see(0.8)
    assert watched.see(0.8).slipping


def test_without_an_arm_or_a_rotation_nothing_is_sudden() -> None:
    memory = assess_slip(SlipMemory(), fused(0.0, at_s=1.0), PARAMS).memory
    assert memory.arm.case is ArmCase.MOVING
    assert memory.baselines.resting_deg == 0.0
    memory = assess_slip(memory, fused(None, at_s=1.1), PARAMS, arm=arm(at_s=1.1)).memory
    assert memory.baselines.resting_deg is None


# --- rest against rest ---


def aloft(rotation_deg: float = 0.0) -> Watched:
    """At rest in the air, after a lift that wound the gel up."""
    watched = Watched(had_rotation=True).rest().lifts(10.0)
    watched.see(rotation_deg)
    watched.lifts(200.0).see(rotation_deg)
    watched.here = arm(200.0)
    return watched.rest(1.0, rotation_deg)


def travels(watched: Watched, to_deg: float) -> bool:
    """The arm moves for a moment and rests; whether what it rotated meanwhile counts as slip."""
    from_deg, height_mm = watched.memory.fingers.last_deg, watched.here.height_mm
    watched.here = arm(height_mm + 20.0, moving=True)
    slips = [watched.see(from_deg + (to_deg - from_deg) * k / 20).slipping for k in range(21)]
    watched.here = arm(height_mm + 20.0)
    return any(slips) or any(watched.see(to_deg).slipping for _ in range(40))


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_rotations_of_several_motions_add_up(sign: float) -> None:
    watched = aloft(5.0 * sign)
    assert not travels(watched, 6.0 * sign)
    assert not travels(watched, 6.9 * sign)
    assert travels(watched, 7.1 * sign)
    assert watched.see(7.1 * sign).rotation_deg == pytest.approx(2.1)


def test_torsion_from_leaving_the_table_does_not_add_up() -> None:
    watched = Watched(had_rotation=True).rest().lifts(10.0)
    for k in range(40):
        watched.here = arm(2.4 * k, moving=True)
        watched.see(0.14 * k)
    watched.here = arm(120.0)
    watched.rest(1.0, 5.6)
    assert not travels(watched, 7.5)


def test_a_lift_in_several_legs_is_allowed_the_torsion_of_one() -> None:
    watched = Watched(had_rotation=True).rest()
    assert not travels(watched, 2.0)
    assert not travels(watched, 4.0)
    assert not travels(watched, 5.9)
    assert travels(watched, 6.1)


def test_rotation_back_to_the_reference_between_two_rests_is_no_slip() -> None:
    watched = aloft(8.0)
    assert not travels(watched, 4.0)
    assert not travels(watched, 8.0)
    assert travels(watched, 10.2)


def test_after_an_episode_the_next_rest_counts() -> None:
    watched = aloft(5.0)
    assert travels(watched, 7.5)
    watched.memory = watched.memory.after_episode(rotated=True, raised=False)
    watched.rest(1.0, 7.5)
    assert not travels(watched, 9.4)
    assert travels(watched, 9.6)


def test_a_drift_at_rest_is_no_rotation_between_two_rests() -> None:
    watched = aloft(5.0)
    for k in range(50 * 60):
        assert not watched.see(5.0 + 0.04 * k * FRAME_S).slipping
    assert not travels(watched, 8.5)


def test_after_putting_down_the_next_lift_starts_over() -> None:
    watched = aloft(5.0)
    watched.putting_down = True
    watched.here = arm(0.0, moving=True)
    watched.see(1.0)
    assert not watched.memory.arm.aloft
    watched.putting_down = False
    watched.here = arm(0.0)
    watched.rest(1.0, 1.0)
    assert not travels(watched, 6.5)


# --- how often it was tightened ---


def test_levels_grow_with_what_was_answered_up_to_four_times() -> None:
    assert [growth(episodes, PARAMS) for episodes in (0, 1, 2, 3, 9)] == [1.0, 2.0, 4.0, 4.0, 4.0]
    assert threshold_deg(0.1, 9, PARAMS) == 4.0 * PARAMS.tuning.tighten_in_motion_deg
    assert threshold_deg(1.0, 1, PARAMS) == 6.0
    assert threshold_deg(9.0, 0, PARAMS) == PARAMS.tuning.sigma_threshold_max_deg


@pytest.mark.parametrize(
    ("rotated", "raised", "rotations"), [(True, True, 3), (False, True, 2), (True, False, 2), (False, False, 2)]
)
def test_rotational_slip_raises_the_levels_only_if_the_force_was_raised(
    rotated: bool, raised: bool, rotations: int
) -> None:
    after = slip_memory(rotations=2, frames=2).after_episode(rotated=rotated, raised=raised)
    assert (after.rotations, after.had_rotation, after.had_slip, after.frames) == (rotations, rotated, True, 0)
    assert (
        after.baselines.resting_deg
        is after.baselines.before_motion_deg
        is after.baselines.episode_deg
        is after.baselines.episode_mm
        is after.baselines.unloaded_deg
        is after.baselines.unloaded_mm
        is None
    )


# --- a finger more or less ---


@pytest.mark.parametrize("apart_deg", [0.4, -0.4, 1.9])
def test_a_finger_that_drops_out_causes_no_rotation(apart_deg: float) -> None:
    for height_mm in (None, 10.0):
        watched = Watched().rest()
        if height_mm is not None:
            watched.lifts(height_mm)
        watched.left_alone = True
        assert not any(watched.see(apart_deg).slipping for _ in range(10))
        watched.left_alone = False
        assert not any(watched.see(0.0).slipping for _ in range(10))


def test_what_no_two_fingers_differ_by_is_slip_though_one_drops_out() -> None:
    watched = Watched().rest()
    watched.left_alone = True
    watched.see(SWITCH_MAX_DEG + 0.6)
    assert watched.see(SWITCH_MAX_DEG + 0.6).slipping


def test_slip_is_seen_though_a_finger_comes_and_goes() -> None:
    watched = Watched().rest()
    watched.rate_deg_s, slips = 24.0, []
    for k in range(1, 8):
        watched.left_alone = not watched.left_alone
        slips.append(watched.see(0.4 * k).slipping)
    assert any(slips)


def test_fingers_that_begin_to_contradict_each_other_cause_no_rotation() -> None:
    watched = Watched().rest(0.5, 0.2)
    watched.conflict = "both images rotate the same way"
    assert not any(watched.see(rotation).slipping for rotation in (0.9, 0.9, -0.8, -0.8, 0.9, 0.9))
    watched.conflict = None
    assert not any(watched.see(0.2).slipping for _ in range(5))
    watched.conflict = "both images rotate the same way"
    watched.rate_deg_s = 20.0
    assert any(watched.see(4.0).slipping for _ in range(2))


def test_a_frame_counts_once_though_the_fingers_are_measured_one_after_the_other() -> None:
    """The left image is taken first: left new with right old, then both new."""
    watched = Watched().rest()
    for moment, rotation_deg in enumerate((0.3, 0.6, 0.3, 0.0, 0.0)):
        watched.now_s += 0.5 * FRAME_S
        view = fused(rotation_deg, 0.0, at_s=watched.now_s - 0.5 * FRAME_S, sigma_deg=0.05)
        view = changed(view, newest_at_s=watched.now_s)
        sight = assess_slip(watched.memory, view, PARAMS, arm=changed(watched.here, measured_at_s=watched.now_s))
        watched.memory = sight.memory
        assert not sight.slipping, moment


def test_slow_slip_is_not_hidden_by_it_where_the_rate_is_unknown() -> None:
    watched = Watched().rest()
    watched.rate_deg_s, slips, rotations = None, [], [0.1 * k for k in range(1, 30)]  # type: ignore[assignment]
    for rotation_deg in rotations:
        watched.left_alone = not watched.left_alone
        slips.append(watched.see(rotation_deg).slipping)
    assert rotations[slips.index(True)] < 0.8
    translates = Watched().rest()
    for k in range(1, 60):
        translates.left_alone, translates.shift_mm = not translates.left_alone, 0.05 * k
        slips.append(translates.see(0.0).slipping)
    assert slips[-1]


def test_a_returning_finger_without_shift_causes_no_slip() -> None:
    watched = Watched()
    watched.elastic_limit = ElasticMotion(UNKNOWN_MAX_DEG, UNKNOWN_MAX_MM)
    watched.rest()
    watched.left_alone, watched.shift_mm = True, None  # type: ignore[assignment]
    assert not any(watched.see(0.3).slipping for _ in range(5))
    watched.left_alone, watched.shift_mm = False, 0.4
    assert not any(watched.see(0.0).slipping for _ in range(5))


@pytest.mark.parametrize("way", [(0.0, 1.0), (0.0, -1.0), (1.0, 0.0), (-1.0, 0.0), (0.6, -0.8)])
def test_a_slide_counts_in_every_direction(way: tuple[float, float]) -> None:
    """The wrist may be turned, so that down is anywhere in the image."""
    memory, slips = SlipMemory(), []
    for number in range(60):
        moved_mm = max(number - 30, 0) * 0.2
        view = changed(
            fused(None, at_s=10.0 + FRAME_S * number, shift_mm=moved_mm * way[1], declined="round contact"),
            sideways_mm=moved_mm * way[0], shift_fingers=("left", "right"),
        )  # fmt: skip
        seen = assess_slip(memory, view, PARAMS, arm=arm(200.0, at_s=view.captured_at_s))
        memory = seen.memory
        slips.append(seen.slipping)
    assert not any(slips[:32])
    assert any(slips[30:40])


@pytest.mark.parametrize("apart_mm", [0.9, -0.9])
def test_a_finger_without_an_angle_that_drops_out_is_no_slide(apart_mm: float) -> None:
    """The fingers' shifts are apart; a slide afterwards is still seen."""
    memory, slips = SlipMemory(), []
    for number in range(90):
        alone = number % 40 >= 20
        moved_mm = max(number - 70, 0) * 0.2
        shift_mm = moved_mm + (apart_mm if alone else 0.5 * apart_mm)
        view = changed(
            fused(None, at_s=10.0 + FRAME_S * number, shift_mm=shift_mm, declined="round contact"),
            sideways_mm=-shift_mm, shift_fingers=("left",) if alone else ("left", "right"),
        )  # fmt: skip
        seen = assess_slip(memory, view, PARAMS, arm=arm(200.0, at_s=view.captured_at_s))
        memory = seen.memory
        slips.append(seen.slipping)
    assert not any(slips[:71])
    assert any(slips[70:82])


@pytest.mark.parametrize("gap_frames", [0, 5])
def test_another_finger_after_a_gap_is_no_slide(gap_frames: int) -> None:
    """The fingers' shifts are 1.8 mm apart; in the gap neither knows its own."""
    memory = SlipMemory()
    for number in range(60):
        known = number < 30 or number >= 30 + gap_frames
        view = changed(
            fused(None, at_s=10.0 + FRAME_S * number, shift_mm=0.0, declined="round contact"),
            shift_mm=(1.8 if number >= 30 else 0.0) if known else None, sideways_mm=0.0 if known else None,
            shift_fingers=("left" if number < 30 else "right",) if known else (),
        )  # fmt: skip
        seen = assess_slip(memory, view, PARAMS, arm=arm(200.0, at_s=view.captured_at_s))
        memory = seen.memory
        assert not seen.slipping


def test_contradicting_shifts_do_not_switch_the_rotation_checks_off() -> None:
    watched = Watched().rest()
    watched.shift_conflict = "one is wrong"
    watched.see(0.6)
    watched.see(0.6)
    assert watched.see(0.6).slipping


@pytest.mark.parametrize(
    ("elastic_mm", "fingers", "slid_mm", "slips"),
    [
        (0.0, 2, 0.6, True),
        (0.0, 2, 0.4, False),
        (0.0, 1, 0.6, False),
        (0.4, 2, 0.9, True),
        (0.4, 2, 0.7, False),
        (1.0, 2, 1.2, True),
        (1.0, 2, 1.05, True),
        (0.9, 2, 0.95, False),
    ],
)
def test_a_plain_slide_that_both_fingers_see_needs_one_frame(
    elastic_mm: float, fingers: int, slid_mm: float, slips: bool
) -> None:
    """It counts from 0.5 mm on, or from 0.25 mm in a stiff gel, and is plain beyond twice that."""
    memory = SlipMemory()
    names = ("left", "right")[:fingers]
    for number in range(31):
        view = changed(
            fused(0.0, at_s=10.0 + FRAME_S * number, shift_mm=slid_mm if number == 30 else 0.0, sigma_deg=0.1),
            sideways_mm=0.0, shift_fingers=names,
        )  # fmt: skip
        elastic_limit = ElasticMotion(0.1, elastic_mm) if elastic_mm else NO_MOTION
        seen = assess_slip(memory, view, PARAMS, arm=arm(200.0, at_s=view.captured_at_s), elastic_limit=elastic_limit)
        memory = seen.memory
    assert (seen.slipping, seen.translates, seen.rotates) == (slips, True, False)


def test_a_shift_filter_waits_for_a_newer_frame() -> None:
    begun = ShiftFilter().next(1.0, 0.02)
    assert (begun.smooth_mm, begun.rate_mm_s) == (1.0, 0.0)
    assert begun.next(2.0, 0.0) == begun
    assert begun.next(2.0, 0.02).rate_mm_s > 10.0
    assert begun.next(2.0, 0.02).next(None, 0.02).rate_mm_s == 0.0
    assert begun.jump_mm(2.0) == 1.0
    assert ShiftFilter().jump_mm(2.0) == 0.0
    assert begun.jump_mm(9.0) == SWITCH_SHIFT_MM


def test_an_object_that_slides_sideways_has_not_settled() -> None:
    memory, settled_s = SlipMemory(), []
    for number in range(60):
        view = changed(
            fused(0.0, at_s=10.0 + FRAME_S * number, shift_mm=0.0, sigma_deg=0.1),
            sideways_mm=max(number - 30, 0) * 0.2, shift_fingers=("left", "right"),
        )  # fmt: skip
        seen = assess_slip(memory, view, PARAMS, arm=arm(200.0, at_s=view.captured_at_s))
        memory = seen.memory
        settled_s.append(seen.settled_s)
    assert settled_s[29] > 0.4
    assert max(settled_s[35:]) < 0.1


def test_an_object_that_is_set_down_may_slide_back() -> None:
    """The table pushes it back to where it was gripped; further out it is slip."""
    watched = Watched()
    watched.shift_mm = 3.0
    watched.rest()
    watched.putting_down = True
    for shift_mm in np.arange(3.0, 0.0, -0.2):
        watched.shift_mm = float(shift_mm)
        assert not watched.see(0.0).translates
    for shift_mm in np.arange(0.0, 6.0, 0.2):
        watched.shift_mm = float(shift_mm)
        seen = watched.see(0.0)
    assert seen.translates


def test_shifts_that_contradict_each_other_need_a_second_frame() -> None:
    memory = SlipMemory()
    for number in range(31):
        slid_mm = 5.5 if number == 30 else 0.0
        view = changed(
            fused(0.0, at_s=10.0 + FRAME_S * number, shift_mm=slid_mm, sigma_deg=0.1),
            sideways_mm=0.0, shift_fingers=("left", "right"), shift_conflict="one is wrong" if slid_mm else None,
        )  # fmt: skip
        seen = assess_slip(memory, view, PARAMS, arm=arm(200.0, at_s=view.captured_at_s))
        memory = seen.memory
    assert seen.translates
    assert not seen.slipping


def test_fingers_that_come_and_go_hide_no_long_slide() -> None:
    """One finger is smeared in every other frame while the object slides at 30 mm/s."""
    memory, slips = SlipMemory(), []
    for number in range(90):
        names = ("left",) if number > 30 and number % 2 else ("left", "right")
        view = changed(
            fused(0.0, at_s=10.0 + FRAME_S * number, shift_mm=max(number - 30, 0) * 0.5, sigma_deg=0.1),
            sideways_mm=0.0, shift_fingers=names,
        )  # fmt: skip
        seen = assess_slip(memory, view, PARAMS, arm=arm(200.0, at_s=view.captured_at_s))
        memory = seen.memory
        slips.append(seen.slipping)
    assert any(slips[30:45])
