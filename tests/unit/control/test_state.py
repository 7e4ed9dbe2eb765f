"""The grasp's state from one phase to the next."""

from __future__ import annotations

import math
from dataclasses import replace

from controller_steps import GUARDED, NOW_S, PARAMS, seen_in, state_in
from observations import arm, ask, gripper, observation
from records import grasp_state

from slipguard.control.arm_motion import REPEAT_S
from slipguard.control.control_step import step
from slipguard.control.messages import RequestKind, StopArm
from slipguard.control.state import GripperDelay, Phase, Release, RememberedGrip
from slipguard.control.supervisor import Supervision, supervise


def test_a_new_phase_ends_pause_putting_down_and_release() -> None:
    before = state_in(Phase.LOWERING, paused=True, putting_down=True, release=Release(85.0))
    after = before.entered(Phase.HOLDING, NOW_S)
    assert (after.phase, after.since_s, after.release) == (Phase.HOLDING, NOW_S, None)
    assert (after.arm.paused, after.arm.putting_down) == (False, False)
    assert after.arm.goal_mm == before.arm.goal_mm


def test_the_load_is_known_while_an_object_is_guarded() -> None:
    guarded = state_in(Phase.HOLDING, load=GUARDED.moved((2.0, 0.0, 0.0), put_down=False))
    assert 0.0 < (guarded.load_over_capacity or 0.0) < 1.0
    assert replace(guarded, guarding=False).load_over_capacity is None
    assert grasp_state().load_over_capacity is None


def test_without_a_gripper_no_delay_is_measured() -> None:
    assert GripperDelay().measured(1.0, None) == GripperDelay()


def test_empty_jaws_after_a_restart_end_what_was_remembered() -> None:
    before = grasp_state(found=True, outdated=True, remembered=RememberedGrip(91.0, 30.0))
    for active in (True, False):
        jaws = gripper(0.0, holding=False, width_mm=85.0, active=active, at_s=NOW_S)
        after, _ = step(before, observation(NOW_S, gripper=jaws), PARAMS)
        assert after.adoption.done
        assert (after.adoption.found, after.adoption.outdated) == (True, not active)
        assert after.adoption.remembered is None


def test_guarding_again_in_a_fault_starts_with_the_grip_that_is_there() -> None:
    before = state_in(Phase.FAULT, closing_interrupted=True, closed=False, target_n=40.0)
    assert before.held.load == GUARDED
    jaws = gripper(0.5, at_s=NOW_S)
    after, command = step(before, seen_in(Phase.FAULT, gripper=jaws, request=ask(RequestKind.GUARD_ON)), PARAMS)
    assert command.refusal is None
    assert command.new_reference
    assert (after.grip.target_n, after.grip.closed) == (40.0, True)
    assert not after.hands_off.closing_interrupted
    assert after.grip.commanded_s == -math.inf, "a grip that was taken over is left as it is"
    assert after.held.load != GUARDED


def test_a_release_stops_the_arm_again_until_it_reports_that_it_stands() -> None:
    grasp, commanded = state_in(Phase.LIFTING), []
    moving = arm(50.0, moving=True)
    for number in range(5):
        now_s = NOW_S + number * 0.6 * REPEAT_S
        kind = RequestKind.RELEASE if number == 0 else RequestKind.NONE
        view = observation(now_s, gripper=gripper(40.0, at_s=now_s), arm=moving, request=ask(kind))
        grasp, command = step(grasp, view, PARAMS)
        commanded.append(command.arm)
    assert commanded == [StopArm(), None, StopArm(), None, StopArm()]


def test_while_nothing_is_held_the_supervisor_notes_which_devices_have_reported() -> None:
    known, faults = supervise(Supervision(), grasp_state(), observation(NOW_S), PARAMS)
    assert known == Supervision(NOW_S, NOW_S, arm_known=True, gripper_known=True, frames_known=True)
    assert faults == ()
    later, _ = supervise(known, grasp_state(), observation(NOW_S + 0.02, gripper=None, arm=None), PARAMS)
    assert later == Supervision(NOW_S, NOW_S + 0.02, arm_known=True, gripper_known=True, frames_known=True)
