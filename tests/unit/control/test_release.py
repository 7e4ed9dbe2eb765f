"""Release: the arm stands first, the jaws open in any case, and nothing tightens the object meanwhile."""

from __future__ import annotations

import pytest
from controller_steps import GUARD_MODE, NOW_S, PARAMS, Play, seen_in, state_in
from observations import arm, ask, fused, gripper, observation
from records import changed, released_mm

from slipguard.control.control_step import step
from slipguard.control.messages import LiftArm, RequestKind, StepOutput, StopArm
from slipguard.control.params import GuardParams
from slipguard.control.release import OPEN_ANYWAY_S
from slipguard.control.reports import FaultCode
from slipguard.control.state import Phase


def lifting(params: GuardParams = PARAMS) -> Play:
    """The arm on its way up, or (guard mode) another program's."""
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


def stops(commands: list[StepOutput]) -> int:
    return sum(command.arm == StopArm() for command in commands)


@pytest.mark.parametrize("params", [PARAMS, GUARD_MODE], ids=["lift", "guard"])
def test_the_jaws_open_when_the_arm_stands(params: GuardParams) -> None:
    play = lifting(params)
    first = play.step(RequestKind.RELEASE)
    assert first.arm == StopArm()
    assert released_mm(first) is None
    waited = play.steps(0.3)
    assert stops(waited) >= 2, "a lost stop is made up for"
    assert all(released_mm(command) is None for command in waited)
    play.here = changed(play.here, moving=False)
    command = play.step()
    assert released_mm(command) == 85.0
    assert command.arm is None
    play.step()
    assert play.grasp.phase is Phase.IDLE


def test_an_arm_commanded_a_moment_ago_does_not_count_as_standing() -> None:
    play = Play().held()
    assert isinstance(play.step(RequestKind.LIFT).arm, LiftArm)
    command = play.step(RequestKind.RELEASE)  # it has not taken it up yet
    assert command.arm == StopArm()
    assert released_mm(command) is None
    assert released_mm(play.step()) == 85.0


@pytest.mark.parametrize("silent", ["gone", "old", "moving"])
def test_the_jaws_open_in_the_end_with_any_state_of_the_arm(silent: str) -> None:
    here = {"gone": None, "old": arm(20.0, at_s=NOW_S - 1.0), "moving": arm(20.0, moving=True, at_s=NOW_S + 9.0)}
    view = seen_in(Phase.HOLDING, arm=here[silent], request=ask(RequestKind.RELEASE))
    state, command = step(state_in(Phase.HOLDING), view, PARAMS)
    opened, waited_s = released_mm(command), 0.0
    while opened is None:
        waited_s += 0.02
        state, command = step(state, observation(NOW_S + waited_s, arm=here[silent]), PARAMS)
        opened = released_mm(command)
        assert waited_s <= OPEN_ANYWAY_S + 0.02
    assert waited_s >= OPEN_ANYWAY_S - 0.02
    assert opened == 85.0


def test_asked_again_the_wait_gets_no_longer_and_the_newest_width_counts() -> None:
    play = lifting()
    play.step(RequestKind.RELEASE)
    for _ in range(24):
        assert released_mm(play.step(RequestKind.RELEASE, width_mm=60.0)) is None
    assert 60.0 in [released_mm(command) for command in play.steps(0.04)]


def test_a_moving_arm_is_stopped_until_the_jaws_are_open_and_then_given_up() -> None:
    play = lifting()
    play.step(RequestKind.RELEASE)
    play.steps(OPEN_ANYWAY_S + 0.02)
    assert play.jaws.force_n == 0.0
    assert play.grasp.phase is Phase.RELEASED
    assert stops(play.steps(PARAMS.tuning.stuck_timeout_s - 0.1)) >= 15
    play.steps(0.2)
    assert play.grasp.phase is Phase.IDLE
    assert any("the arm has not reported that it stands" in (command.text or "") for command in play.commands)
    assert stops(play.steps(0.5)) == 0


def test_an_arm_that_has_stood_is_free_while_the_jaws_still_open() -> None:
    play = Play(GUARD_MODE)
    play.step()
    play.jaws, play.view = gripper(55.0), fused()
    play.steps(0.3)
    play.step(RequestKind.RELEASE)
    play.jaws = changed(play.jaws, moving=True)
    play.here = arm(20.0, moving=True)
    assert stops(play.steps(0.3)) == 0


def stuck() -> Play:
    """A release was requested, but the jaws did not open: a fault, with the object still there."""
    play = Play().held()
    play.step(RequestKind.RELEASE)
    for _ in range(110):
        play.jaws = gripper(40.0)
        play.step()
    assert play.grasp.fault is not None
    assert play.grasp.fault.code is FaultCode.GRIPPER_STUCK
    return play


def test_after_a_release_request_the_grip_is_not_tightened() -> None:
    play = stuck()
    play.slips(20.0, 100.0, frames=20)
    play.jaws = gripper(20.0)
    play.steps(0.5)
    assert all(command.hold_force_n is None for command in play.commands[-150:])


def test_after_a_release_request_the_object_is_not_lost() -> None:
    play = stuck()
    play.jaws = gripper(0.0, holding=False)
    assert all(command.text is None for command in play.steps(0.5))


def test_guarded_again_on_request() -> None:
    play = stuck()
    command = play.step(RequestKind.GUARD_ON)
    assert command.new_reference
    assert play.grasp.phase is Phase.FAULT
    assert play.grasp.grip.target_n == 40.0
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
    assert "nothing is held" in str(play.step(RequestKind.GUARD_ON).refusal)
    assert play.grasp.hands_off.release_requested
