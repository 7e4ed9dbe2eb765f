"""Restarts, guard mode and notes."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
from controller_steps import GUARD_MODE, NOW_S, PARAMS, Play, seen_in, state_in
from observations import arm, ask, fused, gripper
from records import changed, grasp_state, moved_mm, released_mm

from slipguard.control.control_step import ControlState, step
from slipguard.control.messages import LiftArm, RequestKind, StopArm
from slipguard.control.state import Phase, RememberedGrip
from slipguard.devices import GripperState


def test_a_restart_adopts_what_is_held() -> None:
    play = Play()
    play.jaws, play.view, play.here = gripper(93.0), fused(), arm(60.0)
    play.step()
    assert play.grasp.phase is Phase.REFERENCE
    play.steps(0.5)
    assert play.grasp.phase is Phase.HOLDING
    assert play.grasp.grip.target_n == 93.0
    assert all(command.hold_force_n is released_mm(command) is None for command in play.commands)
    assert "way down is unknown" in str(play.step(RequestKind.LOWER).refusal)
    assert play.slips().hold_force_n == pytest.approx(130.0, abs=0.85)


def test_a_restart_knows_the_force_of_before_where_the_jaws_have_not_moved() -> None:
    before = ControlState(grasp_state(remembered=RememberedGrip(93.0, gripper().width_mm + 0.4)))
    play = Play(guard=before)
    play.jaws, play.view, play.here = gripper(20.0), fused(), arm(60.0)
    play.steps(0.6)
    assert play.grasp.phase is Phase.HOLDING
    assert play.grasp.grip.target_n == 93.0
    assert all(command.hold_force_n is None for command in play.commands)
    assert any("93 N from before the restart" in (command.text or "") for command in play.commands)
    assert play.slips().hold_force_n == pytest.approx(130.0, abs=0.85)


@pytest.mark.parametrize(("moved_mm", "known_n"), [(3.0, 93.0), (0.0, 10.0)])
def test_what_is_remembered_of_something_else_does_not_count(moved_mm: float, known_n: float) -> None:
    play = Play(guard=ControlState(grasp_state(remembered=RememberedGrip(known_n, gripper().width_mm + moved_mm))))
    play.jaws, play.view, play.here = gripper(20.0), fused(), arm(60.0)
    play.steps(0.6)
    assert play.grasp.grip.target_n == 20.0


def test_what_is_remembered_is_forgotten_with_empty_jaws() -> None:
    play = Play(guard=ControlState(grasp_state(remembered=RememberedGrip(93.0, gripper().width_mm))))
    play.step()
    assert play.grasp.adoption.remembered is None
    play.held()
    assert play.grasp.grip.target_n == pytest.approx(PARAMS.first_force_n, abs=0.85)


def test_an_adopted_grip_above_the_force_limit_is_kept() -> None:
    play = Play()
    play.jaws, play.view = gripper(200.0), fused()
    play.steps(0.5)
    play.slips(30.0, 100.0, frames=30)
    assert play.grasp.grip.target_n == 200.0


def test_guard_mode_guards_what_another_program_grips() -> None:
    play = Play(GUARD_MODE)
    play.step()
    play.jaws = gripper(55.0)
    play.steps(0.1)
    assert play.grasp.phase is Phase.IDLE  # no contact seen yet
    play.view = fused()
    command = play.step()
    assert command.new_reference
    assert command.text == "an object is held with 55 N: guarding"
    play.steps(0.1)
    assert play.grasp.phase is Phase.HOLDING
    play.here = arm(10.0, moving=True)
    command = play.slips()
    assert command.hold_force_n is not None
    assert command.arm == StopArm()
    for kind in (RequestKind.LIFT, RequestKind.LOWER):
        assert "belongs to another program" in str(play.step(kind).refusal)
    assert all(not isinstance(command.arm, LiftArm) for command in play.commands)


def test_guard_mode_off_and_on() -> None:
    play = Play(GUARD_MODE)
    play.step(RequestKind.GUARD_OFF)
    play.jaws, play.view = gripper(55.0), fused()
    play.steps(0.2)
    assert play.grasp.phase is Phase.IDLE
    play.step(RequestKind.GUARD_ON)
    assert play.grasp.phase is Phase.REFERENCE
    empty = Play(GUARD_MODE)
    assert empty.step(RequestKind.GUARD_ON).text == "will guard the next object that is gripped"


def test_another_program_tightens_but_never_loosens() -> None:
    play = Play(GUARD_MODE)
    play.jaws, play.view = gripper(55.0), fused()
    play.steps(0.3)
    assert play.step(RequestKind.GRIPPER, width_mm=0.0, force_n=80.0).hold_force_n == pytest.approx(80.0, abs=0.85)
    held_n = play.grasp.grip.target_n
    assert play.step(RequestKind.GRIPPER, width_mm=0.0, force_n=30.0).hold_force_n == held_n
    assert "support it, then use release" in str(play.step(RequestKind.GRIPPER, width_mm=60.0).refusal)
    assert "give a width, a force or both" in str(play.step(RequestKind.GRIPPER).refusal)


def test_another_program_moves_the_empty_jaws() -> None:
    command = Play(GUARD_MODE).step(RequestKind.GRIPPER, width_mm=50.0, force_n=25.0)
    assert moved_mm(command) == 50.0
    assert command.gripper.force_n == pytest.approx(25.0, abs=0.85)
    assert "not guarded" not in (command.text or ""), "in guard mode what they meet is"
    assert "give the width" in str(Play(GUARD_MODE).step(RequestKind.GRIPPER, force_n=25.0).refusal)
    stopped = Play(GUARD_MODE)
    stopped.here = arm(protective=True)
    assert "protective" in str(stopped.step(RequestKind.GRIPPER, width_mm=50.0).refusal)
    gone = Play(GUARD_MODE)
    gone.jaws = None  # type: ignore[assignment]
    assert "not connected" in str(gone.step(RequestKind.GRIPPER, width_mm=50.0).refusal)


@pytest.mark.parametrize("jaws", [gripper(0.0, holding=False, active=False), gripper(55.0, fault="overcurrent")])
def test_jaws_that_are_not_ready_are_not_moved(jaws: GripperState) -> None:
    play = Play(GUARD_MODE)
    play.jaws = jaws
    command = play.step(RequestKind.GRIPPER, width_mm=50.0, force_n=60.0)
    assert "not ready" in str(command.refusal)
    assert moved_mm(command) is None
    assert command.hold_force_n is None


def test_in_lift_mode_jaws_moved_by_another_program_are_not_guarded_and_this_is_reported() -> None:
    play = Play()
    assert play.jaws is not None
    play.jaws = changed(play.jaws, width_mm=60.0)
    assert "not guarded until `guard on`" in (play.step(RequestKind.GRIPPER, width_mm=10.0).text or "")
    assert "not guarded" not in (play.step(RequestKind.GRIPPER, width_mm=80.0).text or ""), "opening grips nothing"
    play.jaws = gripper(55.0)
    assert "not guarded until `guard on`" in (play.step(RequestKind.GRIPPER, force_n=80.0).text or "")


def test_an_object_held_unguarded_can_be_gripped_tighter_too() -> None:
    play = Play(GUARD_MODE)
    play.step(RequestKind.GUARD_OFF)
    play.jaws = gripper(55.0)
    assert play.step(RequestKind.GRIPPER, force_n=80.0).hold_force_n == pytest.approx(80.0, abs=0.85)
    assert play.grasp.phase is Phase.IDLE
    assert "not guarded until `guard on`" in (play.step(RequestKind.GRIPPER, force_n=81.0).text or "")


def test_a_lift_waits_until_all_is_ready() -> None:
    def refusal(change: Callable[[Play], object]) -> str:
        play = Play().held()
        change(play)
        return str(play.step(RequestKind.LIFT).refusal)

    assert "slipping" in refusal(lambda play: play.slips())
    assert "not firm yet" in refusal(lambda play: setattr(play, "jaws", changed(play.jaws, moving=True)))
    assert "the arm is not connected" in refusal(lambda play: setattr(play, "here", None))


def test_notes_are_reported_once() -> None:
    play = Play().held()
    play.view = fused(0.0, fingers=("left",), note="right finger: 150 ms behind")
    said = [command.text for command in play.steps(0.3) if command.text]
    assert said == ["right finger: 150 ms behind"]
    play.view = fused()
    assert not any(command.text for command in play.steps(0.9)), "a note that comes and goes is one note"
    play.view = fused(0.0, fingers=("left",), note="right finger: 160 ms behind")
    assert play.step().text is None
    play.view = fused()
    said = [command.text for command in play.steps(1.2) if command.text]
    assert said == ["no longer: right finger: 150 ms behind"]
    play.view = fused(0.0, conflict="both images rotate the same way (left 3, right 3): a fault")
    assert "same way" in (play.step().text or "")


def test_an_episode_of_translational_slip_names_the_distance() -> None:
    play = Play().held()
    play.view = changed(play.view, shift_mm=1.2)
    assert "moved 1.2 mm" in (play.step().text or "")


def test_no_motion_near_a_person() -> None:
    """Also where nothing has latched yet."""
    view = seen_in(Phase.HOLDING, arm=arm(protective=True), request=ask(RequestKind.LIFT))
    assert "protective" in str(step(state_in(Phase.HOLDING), view, PARAMS)[1].refusal)


@pytest.mark.parametrize(
    ("tilt_deg", "refused"),
    [
        (0.0, None),
        (9.9, None),
        (10.1, "at a tilt: its accelerometer measures up 10°"),
        (45.0, "at a tilt: its accelerometer measures up 45°"),
        (90.0, "on a wall: its accelerometer measures up 90°"),
        (180.0, "on the ceiling: its accelerometer measures up 180°"),
    ],
)
@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("kind", [RequestKind.LIFT, RequestKind.LOWER])
def test_an_arm_that_is_not_mounted_upright_is_not_moved(
    kind: RequestKind, axis: int, tilt_deg: float, refused: str | None
) -> None:
    up = [0.0, 0.0, math.cos(math.radians(tilt_deg))]
    up[axis] = math.sin(math.radians(tilt_deg))
    view = seen_in(Phase.HOLDING, arm=changed(arm(50.0, at_s=NOW_S), up=tuple(up)), request=ask(kind))
    state, command = step(state_in(Phase.HOLDING), view, PARAMS)
    assert isinstance(command.arm, LiftArm) is (refused is None)
    assert command.refusal is None if refused is None else refused in str(command.refusal)
    assert state.phase is (Phase.HOLDING if refused else state.phase)


@pytest.mark.parametrize("kind", [RequestKind.LIFT, RequestKind.LOWER])
def test_the_first_leg_counts_from_a_recent_state_of_the_arm(kind: RequestKind) -> None:
    for age_s, moves in ((0.1, True), (0.15, False)):
        view = seen_in(Phase.HOLDING, arm=arm(50.0, at_s=NOW_S - age_s), request=ask(kind))
        state, command = step(state_in(Phase.HOLDING), view, PARAMS)
        assert isinstance(command.arm, LiftArm) is moves
        assert (state.phase is Phase.HOLDING) is not moves
    assert "newest state is 150 ms old, the limit is 100 ms; try again" in str(command.refusal)


def test_a_tighter_grip_asked_for_counts_from_what_is_there() -> None:
    """The gripper may hold more than the controller has commanded."""
    view = seen_in(Phase.HOLDING, gripper=gripper(90.0, at_s=NOW_S), request=ask(RequestKind.GRIPPER, force_n=60.0))
    state, command = step(state_in(Phase.HOLDING), view, PARAMS)
    assert command.hold_force_n == state.grip.target_n == 90.0
