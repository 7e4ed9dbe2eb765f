"""A stop on request: the arm halts in every phase, the grip stays guarded, and nothing moves until the next request."""

from __future__ import annotations

import pytest
from controller_steps import FAULT, GUARD_MODE, NOW_S, PARAMS, Play, seen_in, state_in
from observations import arm, ask, fused, gripper, guard_params
from records import changed, halted, released_mm

from slipguard.control.control_step import step
from slipguard.control.messages import LiftArm, RequestKind, StepOutput, StopArm
from slipguard.control.reports import FaultCode
from slipguard.control.state import AT_STAKE, Phase

HELD = AT_STAKE - {Phase.CLOSING}


def lifting() -> Play:
    """Held, and the arm on its way up."""
    play = Play().held()
    play.step(RequestKind.LIFT)
    play.here = arm(20.0, moving=True)
    play.steps(0.3)
    assert play.grasp.phase is Phase.LIFTING
    return play


def stops(commands: list[StepOutput]) -> int:
    return sum(command.arm == StopArm() for command in commands)


def moves_something(command: StepOutput) -> bool:
    return isinstance(command.arm, LiftArm) or command.gripper is not None


@pytest.mark.parametrize("ill", [False, True], ids=["well", "with a fault in the same step"])
@pytest.mark.parametrize("phase", Phase)
def test_it_is_granted_in_every_phase_and_keeps_the_grip(phase: Phase, ill: bool) -> None:
    view = seen_in(phase, request=ask(RequestKind.STOP), fault=FAULT if ill else None)
    before = state_in(phase)
    state, command = step(before, view, PARAMS)
    assert command.refusal is None
    assert command.arm == StopArm()
    assert released_mm(command) is command.hold_force_n is None
    assert "stopped by request" in (command.text or "")
    assert state.stop is not None
    if phase in HELD or phase is Phase.FAULT:
        assert state.grip.target_n == before.grip.target_n


def test_a_lift_ends_and_nothing_moves_until_the_next_request() -> None:
    play = lifting()
    assert play.step(RequestKind.STOP).arm == StopArm()
    assert play.grasp.phase is Phase.HOLDING
    assert 2 <= stops(play.steps(0.5)) <= 6, "a lost stop is made up for"
    play.here = changed(play.here, moving=False)
    rest = play.steps(3.0)
    assert not any(moves_something(command) for command in rest)
    assert stops(rest) == 0
    assert play.grasp.stop is not None
    assert isinstance(play.step(RequestKind.LIFT).arm, LiftArm)
    assert play.grasp.stop is None


@pytest.mark.parametrize("request_kind", [RequestKind.LIFT, RequestKind.LOWER, RequestKind.RELEASE])
def test_requests_go_on_from_there(request_kind: RequestKind) -> None:
    play = lifting()
    play.step(RequestKind.STOP)
    play.here = changed(play.here, moving=False)
    play.steps(0.5)
    command = play.step(request_kind)
    assert command.refusal is None
    assert command.arm == LiftArm(-20.0, PARAMS.tuning.lower_speed_mm_s) or request_kind is not RequestKind.LOWER
    assert released_mm(command) == 85.0 or request_kind is not RequestKind.RELEASE
    assert play.grasp.stop is None


def test_a_slip_afterwards_is_met_with_force_and_the_arm_stays() -> None:
    play = lifting()
    play.step(RequestKind.STOP)
    play.here = changed(play.here, moving=False)
    play.steps(1.0)
    assert play.slips().hold_force_n is not None
    play.view = fused()
    later = play.steps(5.0)
    assert not any(isinstance(command.arm, LiftArm) for command in later)
    assert play.grasp.phase is Phase.HOLDING


def test_while_the_arm_waits_for_a_slip_to_settle_a_stop_ends_the_lift() -> None:
    play = lifting()
    play.slips(8.0, 60.0)
    play.here = changed(play.here, moving=False)
    play.view = fused()
    play.step(RequestKind.STOP)
    assert not any(isinstance(command.arm, LiftArm) for command in play.steps(5.0))


def test_an_object_is_not_put_down_after_a_stop() -> None:
    """The slip that goes on at the force limit latches its fault, but the arm stays where it was stopped."""
    params = guard_params(on_force_limit="lower", force_max_n=40.0)
    for stopped in (False, True):
        play = Play(params).held()
        play.step(RequestKind.LIFT)
        play.here = arm(20.0, moving=not stopped)
        play.steps(0.3)
        if stopped:
            play.step(RequestKind.STOP)
        commands = []
        for number in range(200):
            play.view = changed(play.view, rotation_deg=4.0 + 0.5 * number, rate_deg_s=25.0)
            commands.append(play.step())
        assert play.grasp.fault is not None
        assert play.grasp.fault.code is FaultCode.FORCE_LIMIT_REACHED
        assert any(isinstance(command.arm, LiftArm) for command in commands) is not stopped


def test_putting_down_ends_and_the_fault_stays() -> None:
    state = state_in(Phase.FAULT, putting_down=True, goal_mm=0.0)
    moving = arm(50.0, moving=True, at_s=NOW_S)
    state, command = step(state, seen_in(Phase.FAULT, arm=moving, request=ask(RequestKind.STOP)), PARAMS)
    assert command.arm == StopArm()
    assert (state.phase, state.arm.putting_down) == (Phase.FAULT, False)
    for number in range(1, 100):
        now_s = NOW_S + 0.02 * number
        view = changed(seen_in(Phase.FAULT), now_s=now_s, arm=arm(50.0, at_s=now_s))
        state, command = step(state, view, PARAMS)
        assert not isinstance(command.arm, LiftArm)


def closing() -> Play:
    play = Play()
    play.step(RequestKind.GRASP)
    play.jaws = gripper(40.0, holding=False, moving=True)
    play.step()
    assert play.grasp.phase is Phase.CLOSING
    return play


def test_closing_jaws_are_halted_and_stay_halted() -> None:
    play = closing()
    assert halted(play.step(RequestKind.STOP))
    again = play.steps(0.5)
    assert sum(halted(command) for command in again) >= 3, "a lost halt is made up for"
    play.jaws = gripper(0.0, holding=True)  # it cannot say what is between them, perhaps a hand
    play.view = fused(30.0, 100.0)
    assert all(command.gripper is None for command in play.steps(2.0))
    assert play.grasp.phase is Phase.IDLE
    assert play.step(RequestKind.GRASP).hold_force_n is not None


def test_jaws_that_have_met_the_object_keep_it() -> None:
    play = Play()
    grasp_n = play.step(RequestKind.GRASP).hold_force_n
    command = play.step(RequestKind.STOP)
    assert play.grasp.phase is Phase.REFERENCE
    assert not halted(command)
    assert play.grasp.grip.target_n == grasp_n


def test_a_closing_under_a_fault_is_halted_and_not_resumed() -> None:
    play = closing()
    play.here = None  # type: ignore[assignment]
    play.steps(6.0)
    assert play.grasp.phase is Phase.FAULT
    assert halted(play.step(RequestKind.STOP))
    play.jaws = gripper(0.0, holding=True)
    play.here = arm()
    assert all(command.gripper is None for command in play.steps(1.0))
    assert "the closing was interrupted" in (play.step(RequestKind.CLEAR).text or "")


def test_jaws_moved_for_another_program_are_halted_and_not_guarded_until_they_are_moved_again() -> None:
    play = Play(GUARD_MODE)
    play.step(RequestKind.GRIPPER, width_mm=20.0)
    play.jaws = gripper(0.0, holding=False, moving=True, width_mm=60.0)
    assert halted(play.step(RequestKind.STOP))
    play.steps(0.3)
    play.jaws, play.view = gripper(0.0, holding=True, width_mm=40.0), fused()
    play.steps(1.0)
    assert play.grasp.phase is Phase.IDLE, "what is between them may be a hand"
    play.jaws = gripper(0.0, holding=False, width_mm=40.0)
    assert play.step(RequestKind.GRIPPER, width_mm=10.0).refusal is None
    play.jaws = gripper(40.0, width_mm=30.0)
    play.steps(0.1)
    assert play.grasp.phase is not Phase.IDLE


def test_a_release_goes_on() -> None:
    """Before the jaws open, and while they do; the arm is stopped either way."""
    play = lifting()
    play.step(RequestKind.RELEASE)
    command = play.step(RequestKind.STOP)
    assert command.arm == StopArm()
    assert "the jaws open all the same" in (command.text or "")
    play.here = changed(play.here, moving=False)
    assert 85.0 in [released_mm(command) for command in play.steps(0.5)]
    play = Play().held()
    assert released_mm(play.step(RequestKind.RELEASE)) == 85.0
    play.jaws = changed(play.jaws, moving=True)
    assert not halted(play.step(RequestKind.STOP))
    assert not any(halted(command) for command in play.steps(0.3))


def test_in_guard_mode_the_other_programs_motion_is_paused_once() -> None:
    """A person who starts that program again at the robot ends the stop."""
    play = Play(GUARD_MODE)
    play.step()
    play.jaws, play.view = gripper(55.0), fused()
    play.here = arm(20.0, moving=True)
    play.steps(0.5)
    assert play.step(RequestKind.STOP).arm == StopArm()
    assert stops(play.steps(0.3)) >= 2
    play.here = changed(play.here, moving=False)
    play.steps(0.5)
    assert play.grasp.stop is not None
    play.here = changed(play.here, moving=True)
    assert stops(play.steps(1.0)) == 0
    assert play.grasp.stop is None


def test_without_an_arm_state_the_stop_is_repeated() -> None:
    play = lifting()
    play.here = None  # type: ignore[assignment]
    play.step(RequestKind.STOP)
    assert stops(play.steps(0.3)) >= 2


def test_in_lift_mode_an_arm_that_a_person_moves_by_hand_is_still_stopped() -> None:
    play = lifting()
    play.step(RequestKind.STOP)
    play.here = changed(play.here, moving=False)
    play.steps(0.5)
    play.here = changed(play.here, moving=True)
    assert stops(play.steps(0.5)) == 0
    assert play.grasp.stop is not None


@pytest.mark.parametrize("holding", [False, True])
def test_requested_jaws_move_while_the_arm_is_still_being_stopped(holding: bool) -> None:
    """Another program goes on commanding the gripper."""
    play = Play(GUARD_MODE)
    play.step(RequestKind.GUARD_OFF)
    play.jaws = gripper(30.0, holding=holding, width_mm=60.0)
    play.here = arm(20.0, moving=True)
    play.step(RequestKind.STOP)
    command = play.step(RequestKind.GRIPPER, width_mm=20.0, force_n=60.0)
    assert command.refusal is None
    assert command.gripper is not None
    play.jaws = changed(play.jaws, moving=True)
    later = play.steps(0.5)
    assert not any(halted(command) for command in later)
    assert stops(later) >= 3


def test_jaws_that_guard_again_under_a_fault_are_not_halted() -> None:
    state = state_in(Phase.FAULT, closing_interrupted=True)
    jaws = gripper(40.0, at_s=NOW_S)
    state, _ = step(state, seen_in(Phase.FAULT, gripper=jaws, request=ask(RequestKind.STOP)), PARAMS)
    state, command = step(state, seen_in(Phase.FAULT, gripper=jaws, request=ask(RequestKind.GUARD_ON)), PARAMS)
    assert command.refusal is None
    state, command = step(state, seen_in(Phase.FAULT, gripper=changed(jaws, moving=True)), PARAMS)
    assert not halted(command)
