"""The force law: how far it tightens, what it leaves alone, and how the margin moves it."""

from __future__ import annotations

import math
from itertools import pairwise

import pytest
from controller_steps import Play
from hypothesis import given
from hypothesis import strategies as st
from observations import arm, fused, guard_params
from records import changed, load_state

from slipguard.control.contact_motion import NOISE_LEAST, ZERO, ContactMotion
from slipguard.control.force_law import ARRIVES, STEP
from slipguard.control.load_state import CAPACITY_EXPONENT, LIMITS_DEG, STIFFNESS_PRIOR, LoadState, LogNormal
from slipguard.control.messages import LiftArm, RequestKind, StopArm
from slipguard.control.params import GuardParams
from slipguard.control.reports import FaultCode
from slipguard.control.state import Phase

KNOWN = LogNormal(0.15, 0.25)
"""A soft gel whose stiffness is known well."""


def lifting(gel: LogNormal = KNOWN, **keys: object) -> Play:
    """An object that is being lifted off."""
    play = Play(guard_params(**keys)).held()
    load = play.grasp.held.load.started(gel, play.grasp.grip.target_n)
    play.guard = changed(play.guard, grasp=changed(play.grasp, held=changed(play.grasp.held, load=load)))
    play.step(RequestKind.LIFT)
    play.here = arm(0.0, moving=True)
    play.view = changed(play.view, sigma_deg=0.1)
    return play


def wind_up(play: Play, to_deg: float, rise_mm: float, seconds: float = 1.0) -> list[float]:
    """Rotate in proportion to the height of the arm, unless it is stopped; return the forces commanded."""
    forces, done = [], 0.0
    for _ in range(round(3.0 * seconds / 0.02)):
        stopped = play.grasp.held.slip is not None
        done = min(done + (0.0 if stopped else 0.02 / seconds), 1.0)
        play.here = arm(done * rise_mm, moving=not stopped)
        play.view = changed(play.view, rotation_deg=done * to_deg, rate_deg_s=None)
        command = play.step()
        forces += [] if command.hold_force_n is None else [command.hold_force_n]
    return forces


def test_elastic_wind_up_of_a_firm_grip_is_left_alone() -> None:
    play = lifting()
    assert wind_up(play, to_deg=2.0, rise_mm=5.0) == []
    assert play.grasp.grip.target_n == pytest.approx(40.0, abs=0.9)


def test_a_load_that_nears_the_capacity_is_answered_before_it_slips() -> None:
    play = lifting()
    forces = wind_up(play, to_deg=12.0, rise_mm=25.0)
    assert forces == sorted(forces)
    assert len(forces) >= 1
    assert all(later >= STEP * before - 0.9 for before, later in pairwise(forces))


def test_a_larger_margin_grips_harder() -> None:
    reached = {margin: max(wind_up(lifting(margin=margin), 6.0, 12.0), default=40.0) for margin in (1.1, 1.3, 2.0)}
    assert reached[1.1] <= reached[1.3] <= reached[2.0]
    assert reached[1.1] < reached[2.0]


@pytest.mark.parametrize(("name", "margin"), [("gentle", 1.15), ("firm", 1.6), (1.4, 1.4)])
def test_the_margin_has_names(name: object, margin: float) -> None:
    assert guard_params(margin=name).margin == margin


@pytest.mark.parametrize("sigma_deg", [0.05, 0.5])
def test_the_width_of_a_constant_sigma_changes_nothing(sigma_deg: float) -> None:
    """What counts is the noise from frame to frame, which is learned at rest."""
    play = lifting(LogNormal(50.0, 0.3))
    play.view = changed(play.view, sigma_deg=sigma_deg, rotation_deg=0.4)
    assert play.step().hold_force_n is not None


def test_a_frame_that_is_much_less_certain_than_usual_is_no_slip() -> None:
    play = lifting(LogNormal(50.0, 0.3))
    play.step()
    play.view = changed(play.view, sigma_deg=2.0, rotation_deg=0.4)
    assert play.step().hold_force_n is None


def test_at_rest_a_leap_of_a_single_frame_waits_for_a_second_one() -> None:
    for second_deg, tightens in ((0.0, False), (0.8, True)):
        play = Play(GuardParams()).held()
        play.view = changed(play.view, rotation_deg=0.8)
        assert play.step().hold_force_n is None
        play.view = changed(play.view, rotation_deg=second_deg)
        forces = [command.hold_force_n for command in play.steps(0.06)]
        play.view = changed(play.view, rotation_deg=0.0 if not tightens else 3.0)
        forces += [command.hold_force_n for command in play.steps(0.04)]
        assert any(force is not None for force in forces) is tightens


def test_the_arm_lifts_off_slowly_speeds_up_once_the_object_hangs_and_stops_while_it_tightens() -> None:
    play = lifting()
    assert LiftArm(100.0, 5.0) in [command.arm for command in play.commands]
    play.steps(0.3)
    play.here = changed(arm(6.0, moving=True), speed_mm_s=5.0)
    sped_up = [command.arm for command in play.steps(0.3) if command.arm is not None]
    assert sped_up
    assert isinstance(sped_up[0], LiftArm)
    assert sped_up[0].speed_mm_s == 50.0
    assert play.grasp.held.load.hangs
    play.here = arm(20.0, moving=True)
    play.view = changed(play.view, rotation_deg=9.0)
    assert play.step().arm == StopArm()


def test_a_lever_that_rotates_fast_is_raised_slowly() -> None:
    play = lifting(LogNormal(0.02, 0.25))
    play.view = changed(play.view, rotation_deg=8.0)
    play.here = arm(2.0)
    legs = [command.arm for command in play.steps(1.0) if isinstance(command.arm, LiftArm)]
    assert legs
    assert all(1.0 <= leg.speed_mm_s <= 1.5 for leg in legs[:1])


def test_an_object_whose_far_end_rests_on_the_table_does_not_hang_and_rotates_no_faster_than_2_deg_s() -> None:
    """It rotates by 0.17 degrees for each mm, the far end of one 340 mm long. Frames are 0.1 s old."""
    play = lifting(LogNormal(0.02, 0.8))
    height_mm, speed_mm_s, speeds = 0.0, 5.0, []
    for _ in range(150):
        play.view = changed(play.view, rotation_deg=0.17 * max(height_mm - 0.1 * speed_mm_s, 0.0), rate_deg_s=None)
        play.here = changed(arm(height_mm, moving=True), speed_mm_s=speed_mm_s)
        command = play.step()
        if isinstance(command.arm, LiftArm):
            speed_mm_s = command.arm.speed_mm_s
        height_mm += 0.02 * speed_mm_s
        speeds.append(speed_mm_s)
    assert not play.grasp.held.load.hangs
    assert height_mm > 20.0
    assert max(speeds) * 0.17 == pytest.approx(2.0, rel=0.25)


def test_an_imprint_that_a_firmer_grip_turns_back_does_not_make_the_object_hang() -> None:
    """Its far end rests on the table, and after the tightening the rotation is estimated half a degree smaller."""
    play = lifting(LogNormal(0.02, 0.8))
    for height_mm, rotation_deg, moving in (
        (6.0, 1.0, False),
        (6.2, 0.5, True),
        (9.0, 0.95, False),
        (11.6, 1.4, False),
    ):
        play.here = arm(height_mm, moving=False)
        play.jaws = changed(play.jaws, moving=moving)
        play.view = changed(play.view, rotation_deg=rotation_deg)
        play.steps(0.06)
    assert not play.grasp.held.load.hangs


def test_what_the_fingers_differ_by_is_found_again_after_a_tightening() -> None:
    """A firmer grip moves the imprint in one of them; when the other is lost for a moment, nothing has moved."""
    motion, moved_mm = ContactMotion(noise=NOISE_LEAST), 0.0
    for k in range(40):
        one_finger, tightening, firmer = k in (5, 35), k == 10, k >= 10
        view = fused(0.0, at_s=0.02 * k, fingers=("left",) if one_finger else ("left", "right"))
        shift_mm = (1.0 if one_finger else 0.3) * firmer
        view = changed(view, shift_mm=shift_mm, shift_fingers=view.fingers)
        motion, moved = motion.followed(view, rests=False, settled=not tightening, sure=True)
        moved_mm += abs(moved[1])
    assert moved_mm == 0.0


def test_lowering_a_rotated_object_onto_the_table_adds_no_force() -> None:
    play = lifting()
    wind_up(play, to_deg=6.0, rise_mm=12.0)
    play.here = arm(30.0)
    play.steps(1.0)
    play.guard = changed(play.guard, grasp=changed(play.grasp, phase=Phase.LOWERING, goal_mm=0.0))
    force_n = play.grasp.grip.target_n
    for k in range(50):
        play.here = arm(30.0 - 0.6 * k, moving=True)
        play.view = changed(play.view, rotation_deg=6.0 - 0.12 * k)
        assert play.step().hold_force_n is None
    assert play.grasp.grip.target_n == force_n
    assert not play.grasp.held.load.hangs


def test_a_slide_by_an_unknown_distance_is_slip() -> None:
    play = Play(GuardParams()).held()
    play.view = changed(play.view, slides=True, shift_mm=None)
    assert play.step().hold_force_n is not None


def test_a_fast_free_slip_is_answered_harder_than_a_slow_one() -> None:
    def first(rate_deg_s: float) -> float:
        return Play(GuardParams()).held().slips(5.0, rate_deg_s, frames=1).hold_force_n or 0.0

    assert first(10.0) < first(150.0)


def test_while_the_force_rises_only_a_free_slip_counts() -> None:
    """The imprint grows with the force, and so seems to move."""
    for rate_deg_s, tightens in ((5.0, False), (400.0, True)):
        play = Play(GuardParams()).held()
        play.slips(4.0, 30.0, frames=1)
        play.jaws = changed(play.jaws, moving=True)
        play.view = changed(play.view, rotation_deg=8.0, rate_deg_s=rate_deg_s)
        assert (play.step().hold_force_n is not None) is tightens


def test_at_the_force_limit_a_motion_beyond_the_elastic_one_is_a_fault() -> None:
    limits = {"force_max_n": 40.0, "no_estimate_force_n": 40.0, "first_force_n": 40.0}
    play = lifting(LogNormal(50.0, 0.3), **limits)
    for k in range(1, 60):
        play.view = changed(play.view, rotation_deg=0.2 * k, rate_deg_s=10.0)
        command = play.step()
        assert command.hold_force_n is None
        if command.fault is not None:
            break
    assert play.grasp.fault is not None
    assert play.grasp.fault.code is FaultCode.FORCE_LIMIT_REACHED
    assert abs(play.view.rotation_deg or 0.0) > 5.0


def test_slip_at_the_force_limit_stops_the_arm_and_is_reported_once() -> None:
    play = Play(guard_params(force_max_n=40.0, no_estimate_force_n=40.0, first_force_n=40.0)).held()
    command = play.slips(3.0, frames=1)
    assert (command.hold_force_n, command.arm) == (None, StopArm())
    assert "39 N is the force limit" in (command.text or "")
    assert "force limit" not in (play.slips(3.1, frames=1).text or "")


def test_a_gripper_weaker_than_the_force_limit_allows_is_not_commanded() -> None:
    play = Play(GuardParams()).held()
    play.params = guard_params(force_max_n=10.0, first_force_n=10.0, no_estimate_force_n=10.0)
    assert play.slips(50.0, 0.0).hold_force_n is None
    assert play.grasp.fault is not None


def test_what_shakes_without_end_is_a_fault() -> None:
    play = Play(guard_params(force_max_n=40.0, no_estimate_force_n=40.0, first_force_n=40.0)).held()
    for k in range(400):
        play.view = changed(play.view, rotation_deg=1.5 * (k % 2))
        if play.step().fault is not None:
            break
    assert play.grasp.fault is not None
    assert play.grasp.fault.code is FaultCode.NOT_SETTLED


@given(st.lists(st.tuples(st.floats(-3.0, 3.0), st.floats(-0.5, 0.5), st.floats(-0.5, 0.5)), max_size=30))
def test_the_load_never_exceeds_the_capacity_and_a_firmer_grip_lowers_it(steps: list[tuple[float, ...]]) -> None:
    load = LoadState().started(STIFFNESS_PRIOR, 40.0)
    for step in steps:
        load = load.moved(step, put_down=False)  # type: ignore[arg-type]
        assert all(math.hypot(*one) <= 1.0 + 1e-9 for one in load.loads)
    before = load.over_capacity(0.7)
    firmer = load.gripped(80.0)
    assert firmer.over_capacity(0.7) == pytest.approx(before * 0.5**CAPACITY_EXPONENT, rel=0.3, abs=1e-9)
    assert firmer.gripped(40.0) is firmer
    assert 0.0 <= before <= load.over_capacity(0.7, (1.0, 0.0, 0.0), ARRIVES) <= max(before, ARRIVES)


def test_back_and_forth_within_the_elastic_limit_leaves_no_load() -> None:
    load = LoadState().started(KNOWN, 40.0)
    there = load.moved((1.0, 0.1, 0.0), put_down=False)
    back = there.moved((-1.0, -0.1, 0.0), put_down=False)
    assert there.over_capacity(0.7) > 0.05
    soft = [math.hypot(*one) for one, limit in zip(back.loads, LIMITS_DEG, strict=True) if limit > 2.0]
    assert max(soft) == pytest.approx(0.0, abs=1e-9)


def test_putting_down_unloads_a_load_of_zero_too() -> None:
    load = changed(LoadState().started(KNOWN, 40.0), motion=ContactMotion(position=(2.0, 0.0, 0.0)))
    assert load.moved((-1.0, 0.0, 0.0), put_down=True).over_capacity(1.0) == 0.0


def test_a_finger_that_comes_and_goes_hides_no_motion() -> None:
    motion, moved_deg = ContactMotion(noise=NOISE_LEAST), 0.0
    for k in range(60):
        fingers = ("left",) if k % 2 else ("left", "right")
        offset_deg = 0.5 if k % 2 else 0.0
        view = fused(0.1 * k + offset_deg, at_s=0.02 * k, fingers=fingers)
        motion, moved = motion.followed(view, rests=False, settled=True, sure=True)
        moved_deg += moved[0]
    assert moved_deg == pytest.approx(5.9, abs=0.3)


def test_what_is_declined_stays_where_it_was_and_counts_when_it_is_back() -> None:
    motion = ContactMotion()
    for k, rotation_deg in enumerate((0.0, None, None, 2.0)):
        view = fused(rotation_deg, at_s=0.02 * k)
        motion, moved = motion.followed(view, rests=True, settled=True, sure=True)
        assert (moved == ZERO) is (rotation_deg != 2.0)
    assert motion.position[0] == pytest.approx(2.0, abs=0.01)


def test_a_frame_of_the_same_moment_changes_no_rate() -> None:
    motion = ContactMotion()
    for at_s, rotation_deg in ((0.0, 0.0), (0.02, 0.01), (0.02, 0.012)):
        motion, _ = motion.followed(fused(rotation_deg, at_s=at_s), rests=True, settled=True, sure=True)
    assert abs(motion.rate[0]) < 1.0


def test_noise_is_learned_at_rest_but_not_from_a_leap() -> None:
    motion = ContactMotion()
    for k in range(100):
        motion, _ = motion.followed(fused(0.05 * (-1) ** k, at_s=0.02 * k), rests=True, settled=True, sure=True)
    noisy_deg = motion.noise[0]
    assert 0.04 < noisy_deg < 0.12
    motion, _ = motion.followed(fused(5.0, at_s=2.0), rests=True, settled=True, sure=True)
    assert motion.noise[0] == noisy_deg


def test_without_an_arm_nothing_hangs() -> None:
    play = Play(guard_params(mode="guard")).held()
    play.here = None  # type: ignore[assignment]
    play.step()
    assert not play.grasp.held.load.hangs


def test_a_load_state_starts_empty() -> None:
    assert load_state().weights == ()
