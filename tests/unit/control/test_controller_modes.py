"""Restarts, guard mode and notes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
from controller_steps import GUARD_MODE, NOW_S, PARAMS, Play, seen_in, state_in
from observations import arm, ask, fused, gripper

from slipguard.control.controller import step
from slipguard.control.messages import ArmLift, RequestKind
from slipguard.control.state import GraspState, Phase, RememberedGrip
from slipguard.control.step import ControlState
from slipguard.devices import GripperState


def test_a_restart_adopts_what_is_held() -> None:
    play = Play()
    play.jaws, play.view, play.here = gripper(93.0), fused(), arm(60.0)
    play.step()
    assert play.grasp.phase is Phase.REFERENCE
    play.steps(0.5)
    assert play.grasp.phase is Phase.HOLDING
    assert play.grasp.target_n == 93.0
    assert all(command.hold_force_n is command.release_width_mm is None for command in play.commands)
    assert "way down is not known" in (play.step(RequestKind.LOWER).refused or "")
    assert play.slips().hold_force_n == pytest.approx(130.0, abs=0.85)


def test_a_restart_knows_the_force_of_before_where_the_jaws_have_not_moved() -> None:
    before = ControlState(GraspState(remembered=RememberedGrip(93.0, gripper().width_mm + 0.4)))
    play = Play(guard=before)
    play.jaws, play.view, play.here = gripper(20.0), fused(), arm(60.0)
    play.steps(0.6)
    assert play.grasp.phase is Phase.HOLDING
    assert play.grasp.target_n == 93.0
    assert all(command.hold_force_n is None for command in play.commands)
    assert any("93 N of before the restart" in (command.say or "") for command in play.commands)
    assert play.slips().hold_force_n == pytest.approx(130.0, abs=0.85)


@pytest.mark.parametrize(("moved_mm", "known_n"), [(3.0, 93.0), (0.0, 10.0)])
def test_what_is_remembered_of_something_else_does_not_count(moved_mm: float, known_n: float) -> None:
    play = Play(guard=ControlState(GraspState(remembered=RememberedGrip(known_n, gripper().width_mm + moved_mm))))
    play.jaws, play.view, play.here = gripper(20.0), fused(), arm(60.0)
    play.steps(0.6)
    assert play.grasp.target_n == 20.0


def test_what_is_remembered_is_forgotten_with_empty_jaws() -> None:
    play = Play(guard=ControlState(GraspState(remembered=RememberedGrip(93.0, gripper().width_mm))))
    play.step()
    assert play.grasp.remembered is None
    play.held()
    assert play.grasp.target_n == pytest.approx(PARAMS.first_force_n, abs=0.85)


def test_an_adopted_grip_above_the_budget_is_kept() -> None:
    play = Play()
    play.jaws, play.view = gripper(200.0), fused()
    play.steps(0.5)
    play.slips(30.0, 100.0, frames=30)
    assert play.grasp.target_n == 200.0


def test_guard_mode_guards_what_another_program_grips() -> None:
    play = Play(GUARD_MODE)
    play.step()
    play.jaws = gripper(55.0)
    play.steps(0.1)
    assert play.grasp.phase is Phase.IDLE  # no contact seen yet
    play.view = fused()
    assert play.step().new_reference
    play.steps(0.1)
    assert play.grasp.phase is Phase.HOLDING
    play.here = arm(10.0, moving=True)
    command = play.slips()
    assert command.hold_force_n is not None
    assert command.arm == "stop"
    for kind in (RequestKind.LIFT, RequestKind.LOWER):
        assert "belongs to another program" in (play.step(kind).refused or "")
    assert all(not isinstance(command.arm, ArmLift) for command in play.commands)


def test_guard_mode_off_and_on() -> None:
    play = Play(GUARD_MODE)
    play.step(RequestKind.GUARD_OFF)
    play.jaws, play.view = gripper(55.0), fused()
    play.steps(0.2)
    assert play.grasp.phase is Phase.IDLE
    play.step(RequestKind.GUARD_ON)
    assert play.grasp.phase is Phase.REFERENCE
    empty = Play(GUARD_MODE)
    assert empty.step(RequestKind.GUARD_ON).say == "will guard what is gripped"


def test_another_program_tightens_but_never_loosens() -> None:
    play = Play(GUARD_MODE)
    play.jaws, play.view = gripper(55.0), fused()
    play.steps(0.3)
    assert play.step(RequestKind.GRIPPER, width_mm=0.0, force_n=80.0).hold_force_n == pytest.approx(80.0, abs=0.85)
    held_n = play.grasp.target_n
    assert play.step(RequestKind.GRIPPER, width_mm=0.0, force_n=30.0).hold_force_n == held_n
    assert "use release" in (play.step(RequestKind.GRIPPER, width_mm=60.0).refused or "")
    assert "give a width, a force or both" in (play.step(RequestKind.GRIPPER).refused or "")


def test_another_program_moves_the_empty_jaws() -> None:
    command = Play(GUARD_MODE).step(RequestKind.GRIPPER, width_mm=50.0, force_n=25.0)
    assert command.move_width_mm == 50.0
    assert command.move_force_n == pytest.approx(25.0, abs=0.85)
    assert "not guarded" not in (command.say or ""), "in guard mode what they meet is"
    assert "give the width" in (Play(GUARD_MODE).step(RequestKind.GRIPPER, force_n=25.0).refused or "")
    stopped = Play(GUARD_MODE)
    stopped.here = arm(protective=True)
    assert "protective" in (stopped.step(RequestKind.GRIPPER, width_mm=50.0).refused or "")
    gone = Play(GUARD_MODE)
    gone.jaws = None  # type: ignore[assignment]
    assert "not there" in (gone.step(RequestKind.GRIPPER, width_mm=50.0).refused or "")


@pytest.mark.parametrize("jaws", [gripper(0.0, holding=False, active=False), gripper(55.0, fault="overcurrent")])
def test_jaws_that_are_not_ready_are_not_moved(jaws: GripperState) -> None:
    play = Play(GUARD_MODE)
    play.jaws = jaws
    command = play.step(RequestKind.GRIPPER, width_mm=50.0, force_n=60.0)
    assert "not ready" in (command.refused or "")
    assert command.move_width_mm is None
    assert command.hold_force_n is None


def test_in_lift_mode_jaws_moved_for_another_program_are_not_guarded_and_that_is_said() -> None:
    play = Play()
    assert play.jaws is not None
    play.jaws = replace(play.jaws, width_mm=60.0)
    assert "not guarded until `guard on`" in (play.step(RequestKind.GRIPPER, width_mm=10.0).say or "")
    assert "not guarded" not in (play.step(RequestKind.GRIPPER, width_mm=80.0).say or ""), "opening grips nothing"
    play.jaws = gripper(55.0)
    assert "not guarded until `guard on`" in (play.step(RequestKind.GRIPPER, force_n=80.0).say or "")


def test_an_object_held_unguarded_can_be_gripped_tighter_too() -> None:
    play = Play(GUARD_MODE)
    play.step(RequestKind.GUARD_OFF)
    play.jaws = gripper(55.0)
    assert play.step(RequestKind.GRIPPER, force_n=80.0).hold_force_n == pytest.approx(80.0, abs=0.85)
    assert play.grasp.phase is Phase.IDLE
    assert "not guarded until `guard on`" in (play.step(RequestKind.GRIPPER, force_n=81.0).say or "")


def test_a_lift_waits_until_all_is_ready() -> None:
    def refusal(change: Callable[[Play], object]) -> str:
        play = Play().held()
        change(play)
        return play.step(RequestKind.LIFT).refused or ""

    assert "slipping" in refusal(lambda play: play.slips())
    assert "not yet firm" in refusal(lambda play: setattr(play, "jaws", replace(play.jaws, moving=True)))
    assert "the arm is not there" in refusal(lambda play: setattr(play, "here", None))


def test_notes_are_said_once() -> None:
    play = Play().held()
    play.view = fused(0.0, fingers=("left",), note="right finger: 150 ms behind")
    said = [command.say for command in play.steps(0.3) if command.say]
    assert said == ["right finger: 150 ms behind"]
    play.view = fused()
    assert not any(command.say for command in play.steps(0.9)), "a note that comes and goes is one note"
    play.view = fused(0.0, fingers=("left",), note="right finger: 160 ms behind")
    assert play.step().say is None
    play.view = fused()
    said = [command.say for command in play.steps(1.2) if command.say]
    assert said == ["no longer: right finger: 150 ms behind"]
    play.view = fused(0.0, conflict="both pictures turn the same way (left 3, right 3): a fault")
    assert "same way" in (play.step().say or "")


def test_an_episode_of_sliding_names_the_slide() -> None:
    play = Play().held()
    play.view = replace(play.view, shift_mm=0.6)
    play.step()
    play.view = replace(play.view, shift_mm=0.9)
    assert "slid 0.9 mm" in (play.step().say or "")


def test_no_motion_near_a_person() -> None:
    """Also where nothing has latched yet."""
    view = seen_in(Phase.HOLDING, arm=arm(protective=True), request=ask(RequestKind.LIFT))
    assert "protective" in (step(state_in(Phase.HOLDING), view, PARAMS)[1].refused or "")


def test_a_tighter_grip_asked_for_counts_from_what_is_there() -> None:
    """The gripper may hold more than the law has commanded."""
    view = seen_in(Phase.HOLDING, gripper=gripper(90.0, at_s=NOW_S), request=ask(RequestKind.GRIPPER, force_n=60.0))
    state, command = step(state_in(Phase.HOLDING), view, PARAMS)
    assert command.hold_force_n == state.target_n == 90.0
