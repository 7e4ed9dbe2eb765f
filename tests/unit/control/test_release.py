"""Release: the arm stands first, the jaws open in any case, and nothing tightens the object meanwhile.

It counts as released only if the gripper, the width and the fingers say so together.
"""

from __future__ import annotations

import pytest
from controller_steps import GUARD_MODE, NOW_S, PARAMS, Play, seen_in, state_in
from observations import arm, ask, fused, gripper, observation
from records import changed, released_mm

from slipguard.control.control_step import ControlState, step
from slipguard.control.finger_fusion import FusedEstimate
from slipguard.control.messages import ActivateGripper, LiftArm, RequestKind, StepOutput, StopArm
from slipguard.control.params import GuardParams
from slipguard.control.release import OPEN_ANYWAY_S
from slipguard.control.reports import FaultCode
from slipguard.control.state import Phase
from slipguard.devices import GripperState


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
    play.steps(0.04)
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
    assert play.grasp.fault.code is FaultCode.NOT_RELEASED
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


OPENED = gripper(0.0, holding=False, width_mm=80.0)
CLOSED = gripper(0.0, holding=False, width_mm=30.0)
CLEAR, TOUCH, BLIND = (False, False), (True, False), (None, None)
OUTCOMES = [
    # what the gripper reports after a release of an object 30 mm wide, contact of the fingers; whether it is released
    (OPENED, CLEAR, True),
    (OPENED, (False, None), True),
    (OPENED, TOUCH, False),
    (OPENED, (None, True), False),
    (OPENED, BLIND, False),
    (CLOSED, CLEAR, False),
    (changed(OPENED, holding=True), CLEAR, False),
    (changed(OPENED, active=False), CLEAR, False),
    (changed(OPENED, fault="overcurrent"), CLEAR, False),
    (changed(CLOSED, active=False), CLEAR, False),
    (changed(OPENED, active=False, auto_released=True), CLEAR, True),
    (changed(OPENED, active=False, auto_released=True), TOUCH, False),
    (changed(OPENED, active=False, auto_released=True), BLIND, False),
    (changed(CLOSED, active=False, auto_released=True), CLEAR, False),
    (changed(CLOSED, moving=True), CLEAR, False),
    (None, CLEAR, False),
]


def seen(contacts: tuple[bool | None, bool | None]) -> FusedEstimate:
    return changed(fused(None, contact=False, shift_mm=None), left_contact=contacts[0], right_contact=contacts[1])


@pytest.mark.parametrize(("jaws", "contacts", "is_out"), OUTCOMES)
@pytest.mark.parametrize("phase", [phase for phase in Phase if phase is not Phase.RELEASED])
def test_what_counts_as_released(
    phase: Phase, jaws: GripperState | None, contacts: tuple[bool | None, bool | None], is_out: bool
) -> None:
    play = Play(guard=ControlState(state_in(phase)))
    play.now_s, play.jaws, play.view, play.opens = NOW_S, gripper(40.0, width_mm=30.0), fused(), False
    play.step(RequestKind.RELEASE)
    play.jaws, play.view = jaws, seen(contacts)
    said = [message.name for command in play.steps(2.2) for message in command.messages]
    assert ("released" in said) is is_out
    assert play.grasp.phase is (Phase.IDLE if is_out else Phase.FAULT)
    if not is_out:
        assert play.grasp.fault is not None
        assert play.grasp.fault.code is FaultCode.NOT_RELEASED
        assert play.grasp.hands_off.release_requested


def test_the_fault_says_what_is_known() -> None:
    play = Play().held()
    play.jaws, play.opens = changed(play.jaws, width_mm=30.0), False
    play.step(RequestKind.RELEASE)
    play.jaws, play.view = OPENED, seen(TOUCH)
    play.steps(2.2)
    assert play.grasp.fault is not None
    assert play.grasp.fault.observed == "the jaws report 80 mm, 30 mm before; the left finger still sees contact"


def test_a_contact_that_was_seen_before_the_jaws_were_open_does_not_count() -> None:
    play = Play().held()
    play.jaws, play.opens = changed(play.jaws, width_mm=30.0), False
    play.step(RequestKind.RELEASE)
    play.jaws, play.view = OPENED, changed(seen(CLEAR), measured_at_s=play.now_s, captured_at_s=play.now_s)
    play.lazy = True
    play.steps(0.2)
    assert play.grasp.phase is Phase.RELEASED
    play.lazy = False
    play.steps(0.04)
    assert play.grasp.phase is Phase.IDLE


def test_a_slow_release_has_time_as_long_as_the_jaws_become_wider() -> None:
    play = Play().held()
    play.jaws, play.opens = gripper(0.0, holding=False, active=False, width_mm=30.0), False
    play.step(RequestKind.RELEASE)
    for width_mm in range(31, 84):
        play.jaws = gripper(0.0, holding=False, active=False, moving=True, width_mm=float(width_mm))
        play.steps(0.1)
        assert play.grasp.phase is Phase.RELEASED
    play.jaws, play.view = changed(play.jaws, moving=False, auto_released=True), seen(CLEAR)
    play.steps(0.04)
    assert play.grasp.phase is Phase.IDLE
    assert "must be activated" in (play.commands[-1].text or "") + (play.commands[-2].text or "")


@pytest.mark.parametrize(("width_mm", "seconds"), [(85.0, 0.06), (50.0, 2.2)], ids=["wide open", "at their limit"])
def test_where_nothing_was_held_open_jaws_are_enough(width_mm: float, seconds: float) -> None:
    play = Play()
    play.jaws, play.view, play.opens = gripper(0.0, holding=False, width_mm=width_mm), seen(BLIND), False
    play.steps(0.1)
    play.step(RequestKind.RELEASE)
    said = [command.text for command in play.steps(seconds) if command.text]
    assert said == [f"nothing was held; the jaws are {width_mm:.0f} mm apart"]
    assert play.grasp.phase is Phase.IDLE


@pytest.mark.parametrize(
    ("jaws", "contacts", "cleared"),
    [
        (changed(CLOSED, active=False), CLEAR, True),
        (changed(CLOSED, active=False), TOUCH, False),
        (changed(CLOSED, active=False), (False, None), False),
        (changed(CLOSED, active=False, auto_released=True), TOUCH, True),
        (changed(CLOSED, fault="overcurrent"), CLEAR, False),
    ],
)
def test_a_gripper_that_is_not_active_is_cleared_only_where_it_is_empty(
    jaws: GripperState, contacts: tuple[bool | None, bool | None], cleared: bool
) -> None:
    """It can only be activated in IDLE, so there must be a way there."""
    play = Play(guard=ControlState(state_in(Phase.FAULT)))
    play.now_s, play.jaws, play.view = NOW_S, jaws, seen(contacts)
    play.step()
    command = play.step(RequestKind.CLEAR)
    assert (play.grasp.phase is Phase.IDLE) is cleared
    assert ("slipguard ctl activate" in (command.text or "")) is cleared
    assert (command.refusal is None) is cleared
    if cleared:
        activation = play.step(RequestKind.ACTIVATE)
        assert activation.gripper == ActivateGripper()
