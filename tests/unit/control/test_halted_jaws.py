"""While a person may be near, moving jaws are halted, and an interrupted closing is not resumed."""

from __future__ import annotations

import pytest
from controller_steps import GUARD_MODE, NOW_S, PARAMS, Play, seen_in, state_in
from observations import arm, ask, fused, gripper
from records import changed, halted, released_mm

from slipguard.control.control_step import step
from slipguard.control.messages import RequestKind
from slipguard.control.state import Phase

STOPPED = arm(emergency=True)


def closing() -> Play:
    """On the way to the object, which has not been met."""
    play = Play()
    play.step(RequestKind.GRASP)
    play.jaws = gripper(40.0, holding=False, moving=True)
    play.step()
    assert play.grasp.phase is Phase.CLOSING
    return play


def halts(play: Play, seconds: float) -> int:
    return sum(halted(command) for command in play.steps(seconds))


def test_a_closing_is_halted_until_the_jaws_rest() -> None:
    play = closing()
    play.here = STOPPED
    command = play.step()
    assert halted(command)
    assert command.hold_force_n is None
    assert "the moving jaws are halted" in (command.text or "")
    again = play.steps(0.3)
    assert sum(halted(command) for command in again) >= 2, "a lost halt is made up for"
    assert all(command.text is None for command in again)
    play.jaws = changed(play.jaws, moving=False)
    assert halts(play, 0.3) == 0


def test_a_close_not_yet_taken_up_is_halted_too() -> None:
    view = seen_in(Phase.CLOSING, gripper=gripper(0.0, holding=False, at_s=NOW_S - 0.01), arm=changed(STOPPED))
    assert halted(step(state_in(Phase.CLOSING, commanded_s=NOW_S - 0.01), view, PARAMS)[1])


@pytest.mark.parametrize("says_it_holds", [True, False])
def test_an_interrupted_closing_must_be_requested_again(says_it_holds: bool) -> None:
    """A gripper halted on its way may hold something, and reports so if that is unknown."""
    play = closing()
    play.here = STOPPED
    play.step()
    play.jaws = gripper(0.0, holding=says_it_holds)
    play.steps(0.3)
    play.view = fused(30.0, 100.0)  # a hand, pulling
    play.here = arm()
    play.steps(1.0)
    assert play.grasp.phase is Phase.FAULT
    assert play.step(RequestKind.CLEAR).refusal is None
    play.steps(0.5)
    assert play.grasp.phase is Phase.IDLE
    assert all(command.hold_force_n is None for command in play.commands[2:])
    play.lazy = True
    assert play.step(RequestKind.GRASP).hold_force_n is not None
    assert play.grasp.phase is Phase.CLOSING


@pytest.mark.parametrize("phase", [Phase.FAULT, Phase.IDLE])
def test_an_interrupted_closing_without_force_is_no_grip_to_guard(phase: Phase) -> None:
    state = state_in(phase, closing_interrupted=True)
    view = seen_in(Phase.FAULT, gripper=gripper(0.0, at_s=NOW_S), request=ask(RequestKind.GUARD_ON))
    after, command = step(state, view, PARAMS)
    assert "interrupted" in str(command.refusal)
    assert after.hands_off.closing_interrupted
    assert after.grip.target_n == state.grip.target_n
    assert not command.new_reference


def test_guarding_an_interrupted_closing_keeps_the_force_target() -> None:
    state = state_in(Phase.FAULT, closing_interrupted=True, target_n=40.0)
    view = seen_in(Phase.FAULT, gripper=gripper(25.0, at_s=NOW_S), request=ask(RequestKind.GUARD_ON))
    after, command = step(state, view, PARAMS)
    assert command.refusal is None
    assert (after.grip.target_n, after.hands_off.closing_interrupted) == (40.0, False)
    assert step(state, changed(view, gripper=gripper(60.0, at_s=NOW_S)), PARAMS)[0].grip.target_n == 60.0


def test_in_guard_mode_an_interrupted_closing_is_not_taken_over() -> None:
    view = seen_in(Phase.HOLDING, gripper=gripper(0.0, at_s=NOW_S))
    state, command = step(state_in(Phase.IDLE, closing_interrupted=True), view, GUARD_MODE)
    assert state.phase is Phase.IDLE
    assert not command.new_reference
    assert step(state_in(Phase.IDLE), view, GUARD_MODE)[0].phase is Phase.REFERENCE


def test_what_an_earlier_stop_has_halted_is_not_yet_gripped() -> None:
    """An answer from before the new grasp: at rest, perhaps something between, no force."""
    state = state_in(Phase.CLOSING, since_s=NOW_S - 0.01, commanded_s=NOW_S - 0.01)
    view = seen_in(Phase.CLOSING, gripper=gripper(0.0, at_s=NOW_S))
    assert step(state, view, PARAMS)[0].phase is Phase.CLOSING


@pytest.mark.parametrize("request_kind", [RequestKind.CLEAR, RequestKind.GUARD_ON])
def test_a_tightening_is_halted_and_its_force_commanded_again_on_request(request_kind: RequestKind) -> None:
    play = Play().held()
    target_n = play.slips().hold_force_n
    play.view = fused()
    assert target_n is not None
    play.jaws = gripper(target_n, moving=True)
    play.here = STOPPED
    assert halted(play.step())
    play.jaws = gripper(0.0)  # it cannot say what it had reached
    play.steps(0.5)
    assert play.grasp.grip.target_n == target_n
    play.here = arm()
    assert {command.hold_force_n for command in play.steps(0.5)} == {None}, "a hand may still be there"
    play.step(request_kind)
    assert target_n in [command.hold_force_n for command in play.steps(0.3)]
    assert not play.grasp.hands_off.closing_interrupted


def test_slip_after_a_stop_adds_no_force_until_clear() -> None:
    play = Play().held()
    play.here = STOPPED
    play.step()
    play.here = arm()
    assert play.slips(5.0).hold_force_n is None
    play.slips(50.0, 100.0, frames=20)
    assert all(command.hold_force_n is None for command in play.commands[-25:])
    play.view = fused()
    play.step(RequestKind.CLEAR)
    play.steps(0.5)
    assert play.slips(5.0).hold_force_n is not None


def test_each_stop_halts_the_jaws_again() -> None:
    play = closing()
    for _ in range(2):
        play.here = STOPPED
        assert halted(play.step())
        play.here = arm()
        assert not halted(play.step())


def test_jaws_at_rest_and_jaws_that_open_on_request_are_let_be() -> None:
    play = Play().held()
    play.here = STOPPED
    assert halts(play, 0.3) == 0
    play.step(RequestKind.RELEASE)
    play.jaws = changed(play.jaws, moving=True)
    assert halts(play, 0.3) == 0
    play.jaws = None  # type: ignore[assignment]
    assert halts(play, 0.3) == 0


def test_while_a_release_waits_for_the_arm_nothing_tightens() -> None:
    play = Play().held()
    play.jaws = gripper(90.0, moving=True)
    play.here = arm(20.0, moving=True, protective=True)
    command = play.step(RequestKind.RELEASE)
    assert released_mm(command) is None
    assert halted(play.step())
