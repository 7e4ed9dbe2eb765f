"""How slip of a held object is met, and what follows if that has no effect."""

from __future__ import annotations

import pytest
from controller_steps import FAULT, NOW_S, PARAMS, Play, seen_in, state_in
from observations import arm, ask, fused, gripper, guard_params, observation
from records import changed

from slipguard.control.control_step import step
from slipguard.control.force_law import STEP
from slipguard.control.messages import LiftArm, RequestKind, StopArm
from slipguard.control.reports import FaultCode
from slipguard.control.state import Phase
from slipguard.devices import GripperState


def test_slip_tightens_at_once_stops_the_arm_and_settles() -> None:
    play = Play().held()
    command = play.slips(frames=1)
    assert command.hold_force_n is not None
    assert command.hold_force_n >= STEP * 40.0
    assert command.arm == StopArm()
    assert "tightening" in (command.text or "")
    assert command.is_warning
    play.view = changed(play.view, rate_deg_s=0.0)
    (settled,) = [later for later in play.steps(2.0) if "settled" in (later.text or "")]
    assert not settled.is_warning


def test_rotation_in_either_direction_is_slip() -> None:
    assert Play().held().slips(-4.0, -30.0).hold_force_n is not None


def test_a_frame_counts_once_however_often_it_is_assessed() -> None:
    play = Play().held()
    play.slips(frames=1)
    play.jaws = changed(play.jaws, force_n=play.grasp.grip.target_n)
    play.lazy = True
    assert all(command.hold_force_n is None for command in play.steps(0.2))


def test_without_stop_on_slip_the_arm_goes_on() -> None:
    play = Play(PARAMS.model_copy(update={"stop_on_slip": False})).held()
    command = play.slips()
    assert command.hold_force_n is not None
    assert command.arm is None


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
    command = play.slips(50.0, 300.0)
    command = play.commands[-1]
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


def test_the_force_limit_reached_is_a_fault_that_keeps_the_grip() -> None:
    play = Play(guard_params(force_max_n=60.0, no_estimate_force_n=60.0)).held()
    for rotation_deg in range(4, 40, 2):
        play.slips(float(rotation_deg), 40.0, frames=5)
    assert play.grasp.fault is not None
    assert play.grasp.fault.code is FaultCode.FORCE_LIMIT_REACHED
    assert play.grasp.grip.target_n <= 60.0
    assert any(command.arm == StopArm() for command in play.commands)


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
    play.view = changed(play.view, rotation_deg=4.0, rate_deg_s=30.0)
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
