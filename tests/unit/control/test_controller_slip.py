"""What is slip, how it is met, and what follows if that has no effect."""

from __future__ import annotations

import pytest
from controller_steps import FAULT, NOW_S, PARAMS, PRIMED, Play, seen_in, state_in
from observations import arm, ask, fused, gripper, guard_params, observation
from records import changed

from slipguard.control.control_step import step
from slipguard.control.messages import LiftArm, RequestKind, StopArm
from slipguard.control.needed_force import GENTLE, PAD, QUICK
from slipguard.control.params import GuardParams
from slipguard.control.reports import FaultCode
from slipguard.control.state import Phase
from slipguard.devices import GripperState

LEAST_STEP = (QUICK.margin * QUICK.ratio_least) ** (1.0 / (1.0 + PAD.gamma))


def test_the_first_step_suits_the_load_and_stops_the_arm() -> None:
    play = Play().held()
    command = play.slips()
    assert command.hold_force_n == pytest.approx(40.2 * LEAST_STEP, abs=0.9)
    assert command.arm == StopArm()
    assert "tightening" in (command.text or "")
    assert command.is_warning
    play.view = changed(play.view, rate_deg_s=0.0)
    (settled,) = [later for later in play.steps(2.0) if "settled" in (later.text or "")]
    assert not settled.is_warning


def test_rotation_in_either_direction_is_slip() -> None:
    assert Play().held().slips(-4.0, -30.0).hold_force_n is not None


@pytest.mark.parametrize(
    ("rotation_deg", "rate_deg_s", "sigma_deg", "frames"),
    [
        (1.9, 90.0, 0.5, 5),  # below the level
        (4.0, 7.0, 0.5, 5),  # too slow: a gel that winds up
        (4.0, -30.0, 0.5, 5),  # coming back
        (4.0, 30.0, 0.5, 1),  # one frame only
        (4.0, 30.0, 1.5, 5),  # within three sigma
        (4.0, None, 0.5, 5),  # no rate known
    ],
)
def test_what_is_not_slip(rotation_deg: float, rate_deg_s: float | None, sigma_deg: float, frames: int) -> None:
    play = Play().held()
    play.view = changed(play.view, sigma_deg=sigma_deg)
    commands = []
    play.view = changed(play.view, rotation_deg=rotation_deg, rate_deg_s=rate_deg_s)
    commands = [play.step() for _ in range(frames)]
    assert all(command.hold_force_n is None for command in commands)


def test_a_frame_counts_once_however_often_it_is_assessed() -> None:
    play = Play().held()
    play.slips(frames=1)
    play.lazy = True
    assert all(command.hold_force_n is None for command in play.steps(0.2))


def test_creeping_rotation_is_slip_at_any_rate() -> None:
    assert Play().held().slips(6.5, 0.5).hold_force_n is not None


def test_an_unsure_estimate_does_not_hide_slip() -> None:
    play = Play().held()
    play.view = changed(play.view, sigma_deg=6.0)
    assert play.slips(5.5, 30.0).hold_force_n is not None


def test_further_steps_wait_until_the_last_could_be_felt_and_for_progress() -> None:
    play = Play().held()
    play.slips(4.0, 30.0)
    first_n = play.grasp.grip.target_n
    for number in range(10):  # 200 ms: 150 until it is felt, 50 until a rate shows it
        assert play.slips(4.5 + 0.5 * number, 40.0, frames=1).hold_force_n is None
    command = play.slips(13.0, 40.0, frames=1)
    assert command.hold_force_n is not None
    assert command.hold_force_n == pytest.approx(first_n * LEAST_STEP, abs=0.9)
    play.steps(0.3)
    assert play.slips(13.5, 40.0, frames=1).hold_force_n is None  # hardly further


@pytest.mark.parametrize(
    ("moving", "rotation_deg", "rate_deg_s", "steps"),
    [
        (True, 8.0, 60.0, False),  # the force still rises
        (False, 8.0, 60.0, True),
        (False, 8.0, 49.0, True),
        (False, 8.0, 46.0, False),  # a fifth slower: it helps
        (True, 24.0, 30.0, True),  # too far to wait
    ],
)
def test_while_the_force_rises_or_the_rotation_slows_down_it_waits(
    moving: bool, rotation_deg: float, rate_deg_s: float, steps: bool
) -> None:
    play = Play().held()
    play.slips(4.0, 60.0)
    play.jaws = changed(play.jaws, moving=moving)
    play.steps(0.24)
    assert (play.slips(rotation_deg, rate_deg_s, frames=1).hold_force_n is not None) is steps


def test_a_rotation_that_stops_slowing_down_is_tightened_again() -> None:
    play = Play().held()
    play.slips(4.0, 60.0)
    play.steps(0.24)
    assert play.slips(8.0, 40.0, frames=1).hold_force_n is None
    assert play.slips(9.5, 40.0, frames=1).hold_force_n is not None


def test_what_the_jaws_took_to_close_is_what_a_step_takes() -> None:
    play = Play()
    play.step(RequestKind.GRASP)
    play.jaws = changed(play.jaws, holding=False, moving=True)
    play.steps(0.1)
    play.jaws = changed(play.jaws, width_mm=80.0)
    play.step()
    play.jaws = changed(play.jaws, width_mm=30.0, holding=True, moving=False)
    play.view = fused()
    play.steps(0.5)
    assert play.grasp.grip.delay.delay_s == pytest.approx(0.12 + 0.016, abs=1e-9)
    play.slips(4.0, 30.0)
    assert play.slips(6.0, 30.0, frames=9).hold_force_n is None
    assert play.slips(8.0, 30.0, frames=1).hold_force_n is not None


@pytest.mark.parametrize(
    ("episodes", "slid_mm", "at_once", "slips"),
    [
        (0, 0.38, True, False),
        (0, 0.42, True, True),
        (0, 1.9, False, False),
        (0, 2.1, False, True),
        (2, 0.38, True, False),
        (2, 0.42, True, True),
    ],
)
def test_translational_slip_has_thresholds_too(episodes: int, slid_mm: float, at_once: bool, slips: bool) -> None:
    """Fast beyond the 0.4 mm of an unknown gel, or at any rate beyond 2 mm, however often it was tightened before."""
    start_mm = 5.0
    memory = changed(PRIMED, rotations=episodes, episode_mm=start_mm, smooth_mm=start_mm)
    if not at_once:
        memory = changed(memory, smooth_mm=start_mm + slid_mm)
    view = seen_in(Phase.HOLDING, fused=fused(0.0, 0.0, at_s=NOW_S, shift_mm=start_mm + slid_mm))
    _, command = step(state_in(Phase.HOLDING, memory=memory), view, PARAMS)
    assert (command.hold_force_n is not None) is slips


def test_settling_ends_an_episode_and_the_next_needs_twice_the_rotation() -> None:
    play = Play().held()
    play.slips(4.0)
    play.view = changed(play.view, rotation_deg=4.5, rate_deg_s=0.0)
    said = " ".join(command.text or "" for command in play.steps(0.6))
    assert "settled at" in said
    assert play.grasp.held.slip is None
    assert play.slips(8.0).hold_force_n is None  # 3.5 degrees more
    assert play.slips(9.0).hold_force_n is not None


def test_a_lift_stops_for_slip_and_continues_after_settling() -> None:
    play = Play().held()
    play.step(RequestKind.LIFT)
    play.here = arm(7.0, moving=True)
    play.step()
    assert play.slips().arm == StopArm()
    stops = [command for command in play.steps(0.5) if command.arm == StopArm()]
    assert 2 <= len(stops) <= 4  # repeated, but not at every tick
    play.here = arm(8.0)
    play.view = changed(play.view, rate_deg_s=0.0)
    commands = play.steps(1.0)
    assert LiftArm(7.0, 20.0) in [command.arm for command in commands]
    assert play.grasp.phase is Phase.HOLDING


def test_without_stop_on_slip_the_arm_goes_on() -> None:
    play = Play(PARAMS.model_copy(update={"stop_on_slip": False})).held()
    command = play.slips()
    assert command.hold_force_n is not None
    assert command.arm is None


@pytest.mark.parametrize(("deg_s", "mm_s"), [(4.0, 0.0), (7.9, 0.0), (0.0, 1.2), (0.0, 2.9)])
def test_slip_below_the_slip_rate_takes_all_the_force_and_then_is_a_fault(deg_s: float, mm_s: float) -> None:
    play = Play(GuardParams()).held()
    forces = [play.grasp.grip.target_n]
    for tick in range(round(5.0 / 0.02)):
        passed_s = 0.02 * tick
        play.view = changed(
            play.view, rotation_deg=deg_s * passed_s, rate_deg_s=deg_s, shift_mm=mm_s * passed_s, sigma_deg=0.1
        )
        forces.append(play.step().hold_force_n or forces[-1])
    assert forces == sorted(forces)
    assert forces[-1] == pytest.approx(130.0, abs=1.0)
    assert play.grasp.fault is not None
    assert play.grasp.fault.code is FaultCode.FORCE_LIMIT_REACHED
    assert play.grasp.held.slip is not None


def test_the_force_limit_reached_is_a_fault_that_keeps_the_grip() -> None:
    play = Play(guard_params(force_max_n=60.0, no_estimate_force_n=60.0)).held()
    for rotation_deg in range(4, 40, 2):
        play.slips(float(rotation_deg), 40.0, frames=5)
    assert play.grasp.fault is not None
    assert play.grasp.fault.code is FaultCode.FORCE_LIMIT_REACHED
    assert play.grasp.grip.target_n <= 60.0
    assert any(command.arm == StopArm() for command in play.commands)


def test_at_the_force_limit_the_arm_waits_and_this_is_reported() -> None:
    play = Play(
        PARAMS.model_copy(update={"force_max_n": 40.0, "no_estimate_force_n": 40.0, "first_force_n": 40.0})
    ).held()
    strongest_n = play.grasp.grip.target_n
    command = play.slips()
    assert (command.hold_force_n, command.arm) == (None, StopArm())
    assert "slip: rotated 4.0° at 30°/s: 39 N is the force limit" in (command.text or "")
    play.view = changed(play.view, rate_deg_s=0.0)
    play.steps(0.6)
    assert play.grasp.held.slip is None
    assert (play.grasp.held.memory.rotations, play.grasp.held.memory.had_rotation) == (0, True)
    assert play.grasp.grip.target_n == strongest_n


def test_a_firm_grip_that_rotates_in_the_lift_off_is_tightened_too() -> None:
    play = Play(guard_params(force_max_n=80.0, no_estimate_force_n=57.0)).held()
    play.step(RequestKind.LIFT)
    play.here = arm(5.0, moving=True)
    play.view = changed(play.view, sigma_deg=0.1)
    play.step()
    command = play.slips(3.1, 5.0)
    assert command.hold_force_n == pytest.approx(40.2 * QUICK.search ** (1.0 / (1.0 + PAD.gamma)), abs=0.9)
    assert command.arm == StopArm()


@pytest.mark.parametrize("lifts", [False, True])
def test_a_gentle_guard_tightens_in_smaller_steps(lifts: bool) -> None:
    force_n = {}
    for gentle in (False, True):
        play = Play(guard_params(gentle=gentle)).held()
        if lifts:
            play.step(RequestKind.LIFT)
            play.here = arm(5.0, moving=True)
        play.step()
        force_n[gentle] = play.slips(4.0, 30.0).hold_force_n or 0.0
    ratio = GENTLE.search if lifts else GENTLE.margin * GENTLE.ratio_least
    assert force_n[True] == pytest.approx(40.2 * ratio ** (1.0 / (1.0 + PAD.gamma)), abs=0.9)
    assert 40.5 < force_n[True] < force_n[False]


def test_both_kinds_of_slip_are_remembered_until_all_has_settled() -> None:
    play = Play().held()
    play.view = changed(play.view, shift_mm=2.5)
    assert play.slips(0.0, 0.0).hold_force_n is not None
    assert play.grasp.held.slip is not None
    assert (play.grasp.held.slip.rotates, play.grasp.held.slip.raised) == (False, True)
    play.steps(0.24)
    play.view = changed(play.view, shift_mm=2.6)
    assert play.slips(7.0, 30.0, frames=1).hold_force_n is not None
    assert play.grasp.held.slip.rotates
    play.view = changed(play.view, rate_deg_s=0.0)
    play.steps(0.8)
    assert play.grasp.held.memory.rotations == 1


@pytest.mark.parametrize(("rotation_deg", "gives_up"), [(44.5, False), (45.5, True), (-45.5, True)])
def test_an_object_rotated_too_far_is_given_up_even_at_rest(rotation_deg: float, gives_up: bool) -> None:
    play = Play().held()
    memory = changed(play.grasp.held.memory, episode_deg=rotation_deg, settled_deg=rotation_deg)
    memory = changed(memory, resting_deg=rotation_deg, before_motion_deg=rotation_deg)
    play.guard = changed(play.guard, grasp=changed(play.grasp, memory=memory))
    assert play.slips(rotation_deg, 0.0, frames=1).fault is None
    command = play.slips(rotation_deg, 0.0, frames=1)
    assert (command.fault is not None) is gives_up
    if gives_up:
        assert play.grasp.fault is not None
        assert play.grasp.fault.code is FaultCode.ROTATED_TOO_FAR
        assert play.grasp.fault.observed == "rotated 46° since it was gripped: tightening from 40 N to 130 N"
        assert command.hold_force_n == pytest.approx(130.0, abs=0.85)
        assert command.arm == StopArm()


def test_neither_a_contradiction_nor_a_single_frame_gives_the_object_up() -> None:
    play = Play().held()
    for rotation_deg in (50.0, 0.0, 50.0, 0.0):
        assert play.slips(rotation_deg, 0.0, frames=1).fault is None
    play.view = changed(play.view, conflict="both images rotate the same way")
    assert all(play.slips(50.0, 0.0, frames=1).fault is None for _ in range(5))


def test_without_a_reference_no_rotation_is_too_far() -> None:
    play = Play().held()
    play.guard = changed(play.guard, grasp=changed(play.grasp, referenced=False))
    assert all(play.slips(50.0, 0.0, frames=1).fault is None for _ in range(5))


def test_rotated_too_far_applies_the_force_limit() -> None:
    play = Play().held()
    play.slips(30.0, 300.0)
    command = play.slips(50.0, 300.0, frames=1)
    assert command.fault is not None
    assert command.fault.code is FaultCode.ROTATED_TOO_FAR
    assert command.hold_force_n == pytest.approx(130.0, abs=0.85)
    assert command.arm == StopArm()
    play.slips(70.0, 300.0, frames=20)
    assert play.grasp.fault is not None
    assert play.grasp.fault.code is FaultCode.ROTATED_TOO_FAR


def test_no_force_is_added_near_a_person() -> None:
    """In a protective or emergency stop a person may be in the jaws, also while the arm no longer says so."""
    play = Play().held()
    play.here = arm(emergency=True)
    play.slips(4.0)
    play.here = None  # type: ignore[assignment]
    play.slips(50.0, 100.0, frames=20)
    assert all(command.hold_force_n is None for command in play.commands[-20:])
    assert play.grasp.grip.target_n == pytest.approx(40.0, abs=0.85)


def test_rotation_back_while_lowering_is_no_slip() -> None:
    slipped = changed(PRIMED, episode_deg=20.0)
    back = seen_in(Phase.LOWERING, fused=fused(15.0, -30.0, at_s=NOW_S))
    for phase, tightens in ((Phase.LOWERING, False), (Phase.HOLDING, True)):
        _, command = step(state_in(phase, memory=slipped), back, PARAMS)
        assert (command.hold_force_n is not None) is tightens


def test_guard_off_only_watches_until_guard_on() -> None:
    play = Play().held()
    play.step(RequestKind.GUARD_OFF)
    assert play.slips(30.0, 50.0, frames=10).hold_force_n is None
    play.step(RequestKind.GUARD_ON)
    play.step()
    assert play.slips(34.0, 50.0).hold_force_n is not None


@pytest.mark.parametrize(
    "changes",
    [
        {"view": fused(None, contact=False, shift_mm=None)},
        {"jaws": gripper(40.0, holding=False, nothing=True)},
        {"jaws": gripper(40.0, holding=False)},
    ],
)
def test_a_lost_object_latches(changes: dict[str, object]) -> None:
    play = Play().held()
    for name, value in changes.items():
        setattr(play, name, value)
    assert all(command.fault is None for command in play.steps(0.08))
    command = play.steps(0.08)[-1]
    assert command.fault is not None
    assert command.fault.code is FaultCode.OBJECT_LOST


def test_a_passing_loss_of_contact_does_not() -> None:
    play = Play().held()
    for _ in range(5):
        play.view = fused(None, contact=False, shift_mm=None)
        play.steps(0.06)
        play.view = fused()
        play.steps(0.04)
    assert play.grasp.phase is Phase.HOLDING


NO_CONTACT = changed(fused(None, contact=False, shift_mm=None), left_contact=None)
"""One finger sees no contact, the other says nothing at all."""


def test_one_fingers_word_for_a_loss_stops_the_arm_and_must_last_three_times_as_long() -> None:
    play = Play().held()
    play.step(RequestKind.LIFT)
    play.here = arm(7.0, moving=True)
    play.view = NO_CONTACT
    assert all(command.arm is None for command in play.steps(0.1))
    assert StopArm() in [command.arm for command in play.steps(0.06)]
    play.here = arm(8.0)
    commands = play.steps(0.12)
    assert all(command.fault is None and not isinstance(command.arm, LiftArm) for command in commands)
    command = play.steps(0.06)[-1]
    assert command.fault is not None
    assert command.fault.code is FaultCode.OBJECT_LOST


def test_a_lift_goes_on_when_the_only_finger_sees_contact_again() -> None:
    play = Play().held()
    play.step(RequestKind.LIFT)
    play.here = arm(7.0, moving=True)
    play.view = NO_CONTACT
    play.steps(0.2)
    play.here = arm(8.0)
    play.view = fused(fingers=("right",))
    commands = play.steps(0.6)
    assert any(isinstance(command.arm, LiftArm) for command in commands)
    assert play.grasp.fault is None


@pytest.mark.parametrize(
    "jaws", [gripper(40.0, holding=False, moving=True), gripper(40.0, holding=False, nothing=True)]
)
def test_a_gripper_that_no_longer_holds_bears_one_finger_out(jaws: GripperState) -> None:
    play = Play().held()
    play.view, play.jaws = NO_CONTACT, jaws
    command = play.steps(0.14)[-1]
    assert command.fault is not None
    assert command.fault.code is FaultCode.OBJECT_LOST


def test_without_a_gripper_one_finger_is_in_doubt_too() -> None:
    play = Play().held()
    play.view, play.jaws = NO_CONTACT, None  # type: ignore[assignment]
    assert all(command.fault is None for command in play.steps(0.28))


def test_in_a_fault_slip_is_still_answered_with_force() -> None:
    play = Play().held()
    play.guard = changed(play.guard, grasp=changed(play.grasp, phase=Phase.FAULT, fault=FAULT))
    assert play.slips().hold_force_n is not None
    assert play.grasp.fault == FAULT


def test_clear_takes_over_what_is_held() -> None:
    state, command = step(
        state_in(Phase.FAULT), seen_in(Phase.FAULT, request=ask(RequestKind.CLEAR), gripper=gripper(77.0)), PARAMS
    )
    assert state.phase is Phase.REFERENCE
    assert state.grip.target_n == 77.0
    assert state.fault is None
    assert state.arm.ground_mm == 0.0
    assert command.new_reference


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"fault": FAULT}, "the cause persists"),
        ({"gripper": None}, "unknown what it holds"),
        ({"arm": arm(protective=True)}, "protective"),
    ],
)
def test_clear_needs_the_cause_to_be_gone(changes: dict[str, object], says: str) -> None:
    view = seen_in(Phase.FAULT, request=ask(RequestKind.CLEAR), **changes)
    state, command = step(state_in(Phase.FAULT), view, PARAMS)
    assert state.phase is Phase.FAULT
    assert says in str(command.refusal)


UNTRUSTED = changed(FAULT, code=FaultCode.ESTIMATE_UNTRUSTED)


def test_clear_takes_a_new_reference_where_the_fingers_contradict_each_other() -> None:
    view = seen_in(Phase.FAULT, request=ask(RequestKind.CLEAR), fault=UNTRUSTED)
    state, command = step(state_in(Phase.FAULT), view, PARAMS)
    assert state.phase is Phase.REFERENCE
    assert command.new_reference
    assert command.refusal is None


def test_clear_is_refused_while_another_fault_persists() -> None:
    view = seen_in(Phase.FAULT, request=ask(RequestKind.CLEAR), fault=UNTRUSTED, other_faults=(FAULT,))
    state, command = step(state_in(Phase.FAULT), view, PARAMS)
    assert state.phase is Phase.FAULT
    assert "the cause persists" in str(command.refusal)
    assert command.is_warning, "both are said, and are no mere news"
    assert not step(state, changed(view, request=ask(RequestKind.CLEAR)), PARAMS)[1].is_warning, "once"


def test_what_a_tick_has_to_say_is_not_lost_on_a_request() -> None:
    play = Play().held()
    play.slips(frames=1)
    command = play.step(RequestKind.GUARD_ON)
    assert command.hold_force_n is not None
    assert "tightening" in (command.text or "")
    assert (command.text or "").endswith("; guarding")
    view = seen_in(Phase.FAULT, request=ask(RequestKind.GUARD_ON), fault=UNTRUSTED, other_faults=(FAULT,))
    said = step(state_in(Phase.FAULT, closed=True), view, PARAMS)[1].text or ""
    assert str(FAULT) in said
    assert said.endswith("the fault stays latched until it is cleared")


def test_clear_with_nothing_held_is_idle() -> None:
    view = seen_in(Phase.FAULT, request=ask(RequestKind.CLEAR), gripper=gripper(0.0, holding=False))
    assert step(state_in(Phase.FAULT), view, PARAMS)[0].phase is Phase.IDLE


def test_a_stop_is_repeated_until_the_arm_stands() -> None:
    state, stops = state_in(Phase.FAULT, arm_commanded_s=NOW_S), 0
    for number in range(1, 31):
        now_s = NOW_S + 0.02 * number
        state, command = step(state, observation(now_s, arm=None if number < 20 else arm(at_s=now_s)), PARAMS)
        stops += command.arm == StopArm()
    assert stops == 3


def test_a_force_that_was_not_taken_is_commanded_again() -> None:
    play = Play().held()
    play.slips()
    wanted_n = play.grasp.grip.target_n
    play.jaws = changed(play.jaws, force_n=40.0)
    again = [command.hold_force_n for command in play.steps(0.25) if command.hold_force_n is not None]
    assert again[0] == wanted_n


def test_a_gripper_opened_by_hand_is_not_closed_again() -> None:
    play = Play().held()
    play.jaws = changed(play.jaws, force_n=0.0, holding=False, width_mm=85.0)
    assert all(command.hold_force_n is None for command in play.steps(1.0))
    assert play.grasp.fault is not None
