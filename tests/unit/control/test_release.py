"""Letting go: the arm stands first, the jaws open in the end, and nothing tightens what was to be let go."""

from __future__ import annotations

from dataclasses import replace

import pytest
from controller_steps import GUARD_MODE, NOW_S, PARAMS, Play, seen_in, state_in
from observations import arm, ask, fused, gripper, observation

from slipguard.control.controller import step
from slipguard.control.fault import FaultCode
from slipguard.control.messages import ArmLift, Command, RequestKind
from slipguard.control.params import GuardParams
from slipguard.control.release import OPEN_ANYWAY_S
from slipguard.control.state import Phase


def lifting(params: GuardParams = PARAMS) -> Play:
    """The arm on its way up, or (guard mode) somebody else's."""
    play = Play(params)
    if params.mode == "guard":
        play.step()
        play.jaws, play.view = gripper(55.0), fused()
        play.steps(0.3)
    else:
        play.held()
        play.step(RequestKind.LIFT)
    play.here = arm(20.0, moving=True)
    play.step()
    return play


def stops(commands: list[Command]) -> int:
    return sum(command.arm == "stop" for command in commands)


@pytest.mark.parametrize("params", [PARAMS, GUARD_MODE], ids=["lift", "guard"])
def test_the_jaws_open_when_the_arm_stands(params: GuardParams) -> None:
    play = lifting(params)
    first = play.step(RequestKind.RELEASE)
    assert first.arm == "stop"
    assert first.release_width_mm is None
    waited = play.steps(0.3)
    assert stops(waited) >= 2, "a lost stop is made up for"
    assert all(command.release_width_mm is None for command in waited)
    play.here = replace(play.here, moving=False)
    command = play.step()
    assert command.release_width_mm == 85.0
    assert command.arm is None
    play.step()
    assert play.grasp.phase is Phase.IDLE


def test_an_arm_told_to_move_a_moment_ago_does_not_pass_for_one_that_stands() -> None:
    play = Play().held()
    assert isinstance(play.step(RequestKind.LIFT).arm, ArmLift)
    command = play.step(RequestKind.RELEASE)  # it has not taken it up yet
    assert command.arm == "stop"
    assert command.release_width_mm is None
    assert play.step().release_width_mm == 85.0


@pytest.mark.parametrize("silent", ["gone", "old", "moving"])
def test_the_jaws_open_in_the_end_whatever_the_arm_says(silent: str) -> None:
    here = {"gone": None, "old": arm(20.0, at_s=NOW_S - 1.0), "moving": arm(20.0, moving=True, at_s=NOW_S + 9.0)}
    view = seen_in(Phase.HOLDING, arm=here[silent], request=ask(RequestKind.RELEASE))
    state, command = step(state_in(Phase.HOLDING), view, PARAMS)
    opened, waited_s = command.release_width_mm, 0.0
    while opened is None:
        waited_s += 0.02
        state, command = step(state, observation(NOW_S + waited_s, arm=here[silent]), PARAMS)
        opened = command.release_width_mm
        assert waited_s <= OPEN_ANYWAY_S + 0.02
    assert waited_s >= OPEN_ANYWAY_S - 0.02
    assert opened == 85.0


def test_asked_again_the_wait_gets_no_longer_and_the_newest_width_counts() -> None:
    play = lifting()
    play.step(RequestKind.RELEASE)
    for _ in range(24):
        assert play.step(RequestKind.RELEASE, width_mm=60.0).release_width_mm is None
    assert 60.0 in [command.release_width_mm for command in play.steps(0.04)]


def test_an_arm_that_goes_on_is_told_to_stop_while_and_after_the_jaws_open_and_then_given_up() -> None:
    play = lifting()
    play.step(RequestKind.RELEASE)
    play.steps(OPEN_ANYWAY_S + 0.02)
    assert play.jaws.force_n == 0.0
    assert play.grasp.phase is Phase.RELEASED
    assert stops(play.steps(PARAMS.tuning.stuck_timeout_s - 0.1)) >= 15
    play.steps(0.2)
    assert play.grasp.phase is Phase.IDLE
    assert any("the arm has not said that it stands" in (command.say or "") for command in play.commands)
    assert stops(play.steps(0.5)) == 0


def test_an_arm_that_has_stood_is_free_while_the_jaws_still_open() -> None:
    play = Play(GUARD_MODE)
    play.step()
    play.jaws, play.view = gripper(55.0), fused()
    play.steps(0.3)
    play.step(RequestKind.RELEASE)
    play.jaws = replace(play.jaws, moving=True)
    play.here = arm(20.0, moving=True)
    assert stops(play.steps(0.3)) == 0


def stuck() -> Play:
    """Asked to let go, not opened: a fault, with the object still there."""
    play = Play().held()
    play.step(RequestKind.RELEASE)
    for _ in range(110):
        play.jaws = gripper(40.0)
        play.step()
    assert play.grasp.fault is not None
    assert play.grasp.fault.code is FaultCode.GRIPPER_STUCK
    return play


def test_what_was_to_be_let_go_is_not_gripped_tighter() -> None:
    play = stuck()
    play.slips(20.0, 100.0, frames=20)
    play.jaws = gripper(20.0)
    play.steps(0.5)
    assert all(command.hold_force_n is None for command in play.commands[-150:])


def test_what_was_to_be_let_go_is_not_missed_when_it_goes() -> None:
    play = stuck()
    play.jaws = gripper(0.0, holding=False)
    assert all(command.say is None for command in play.steps(0.5))


def test_guarded_again_when_somebody_says_so() -> None:
    play = stuck()
    command = play.step(RequestKind.GUARD_ON)
    assert command.new_reference
    assert play.grasp.phase is Phase.FAULT
    assert play.grasp.target_n == 40.0
    play.view = fused()
    play.steps(0.3)
    assert play.slips().hold_force_n is not None
    cleared = stuck()
    cleared.step(RequestKind.CLEAR)
    cleared.view = fused()
    cleared.steps(0.3)
    assert cleared.slips().hold_force_n is not None


@pytest.mark.parametrize("jaws", [None, gripper(0.0, holding=False)])
def test_nothing_is_guarded_again_where_nothing_is_held(jaws: object) -> None:
    play = stuck()
    play.jaws = jaws  # type: ignore[assignment]
    assert "nothing is held" in (play.step(RequestKind.GUARD_ON).refused or "")
    assert play.grasp.release_requested
