"""A grasp from the first grip to the release, on request."""

from __future__ import annotations

import pytest
from controller_steps import NOW_S, PARAMS, Play, seen_in, state_in
from observations import arm, ask, fused, gripper, guard_params, observation
from records import changed, released_mm

from slipguard.control.control_step import step
from slipguard.control.messages import LiftArm, RequestKind
from slipguard.control.params import GuardParams
from slipguard.control.phases import NOTHING_S
from slipguard.control.reports import FaultCode
from slipguard.control.state import Phase


def test_grasp_lift_hold_lower_release() -> None:
    play = Play()
    command = play.step(RequestKind.GRASP)
    assert command.hold_force_n == pytest.approx(40.0, abs=0.85)
    assert command.hold_force_n >= 40.0
    command = play.step()
    assert command.new_reference
    assert play.grasp.phase is Phase.REFERENCE
    play.view = fused()
    play.steps(0.1)
    assert play.grasp.phase is Phase.HOLDING
    assert play.grasp.held.referenced
    command = play.step(RequestKind.LIFT)
    assert command.arm == LiftArm(100.0, 5.0)  # slowly, until the object hangs
    legs = [command.arm for command in play.steps(1.0) if command.arm is not None]
    assert legs == []
    assert play.grasp.phase is Phase.HOLDING
    command = play.step(RequestKind.LOWER)
    assert command.arm == LiftArm(-100.0, 30.0)
    play.steps(0.5)
    assert play.grasp.phase is Phase.HOLDING
    command = play.step(RequestKind.RELEASE)
    assert released_mm(command) == 85.0
    play.steps(0.04)
    assert play.grasp.phase is Phase.IDLE
    assert play.grasp.grip.target_n == 0.0
    opened = [command for command in play.commands if released_mm(command) is not None]
    assert len(opened) == 1


def test_what_was_asked_replaces_the_configuration() -> None:
    play = Play()
    assert play.step(RequestKind.GRASP, force_n=60.0).hold_force_n == pytest.approx(60.0, abs=0.85)
    play.step()
    play.view = fused()
    play.step()
    assert play.step(RequestKind.LIFT, height_mm=8.0, speed_mm_s=10.0).arm == LiftArm(8.0, 5.0)
    play.steps(0.5)
    assert play.step(RequestKind.LOWER, height_mm=3.0, speed_mm_s=5.0).arm == LiftArm(-3.0, 5.0)
    play.steps(0.5)
    assert released_mm(play.step(RequestKind.RELEASE, width_mm=40.0)) == 40.0


def test_closing_on_nothing_ends_idle_and_not_closing_ends_in_a_fault() -> None:
    play = Play()
    play.step(RequestKind.GRASP)
    play.jaws = gripper(40.0, holding=False, nothing=True, width_mm=0.0)
    said = [command.text for command in play.steps(NOTHING_S + 0.04)]
    assert said.count("the gripper closed on nothing") == 1
    assert play.grasp.phase is Phase.IDLE
    play.jaws = gripper(40.0, holding=False, moving=True)
    play.step(RequestKind.GRASP)
    play.jaws = changed(play.jaws, holding=False, moving=True)
    play.steps(5.2)
    assert play.grasp.fault is not None
    assert play.grasp.fault.code is FaultCode.GRIPPER_STUCK
    assert play.grasp.fault.observed == "not closed on an object within 5 s"
    assert play.grasp.fault.what_to_do.startswith("keep your hands out of the jaws, which may still close")


def test_jaws_that_stand_apart_without_an_object_are_a_named_fault_that_can_be_cleared() -> None:
    play = Play()
    play.step(RequestKind.GRASP)
    play.jaws = gripper(40.0, holding=False, width_mm=41.0)
    play.steps(0.1)
    play.jaws = changed(play.jaws, holding=False, width_mm=41.0)
    play.steps(5.2)
    assert play.grasp.fault is not None
    assert play.grasp.fault.observed == "not closed on an object within 5 s: the jaws stand 41 mm apart without one"
    assert play.step(RequestKind.CLEAR).refusal is None
    assert play.grasp.phase is Phase.IDLE


def test_one_report_of_closed_on_nothing_does_not_end_a_closing() -> None:
    """It may be from before the command: the jaws would go on to grip the object unguarded."""
    play = Play()
    play.step(RequestKind.GRASP)
    closing, nothing = (gripper(40.0, holding=False, moving=moving, nothing=not moving) for moving in (True, False))
    for _ in range(3):
        play.jaws = nothing
        play.steps(NOTHING_S - 0.02)
        play.jaws = closing
        play.step()
    play.jaws = changed(nothing, moving=True)
    play.steps(2 * NOTHING_S)
    play.jaws = gripper(40.0)
    play.step()
    assert play.grasp.phase is Phase.REFERENCE


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"jaws": None}, "not connected"),
        ({"jaws": gripper(0.0, holding=False, fault="5")}, "not ready"),
        ({"jaws": gripper(0.0, holding=False, active=False)}, "not activated"),
        ({"here": arm(emergency=True)}, "emergency stop"),
        ({"params": guard_params(first_force_n=10.0, no_estimate_force_n=15.0, force_max_n=15.0)}, "below the 20 N"),
    ],
)
def test_grasps_that_are_refused(changes: dict[str, object], says: str) -> None:
    play = Play()
    for name, value in changes.items():
        setattr(play, name, value)
    command = play.step(RequestKind.GRASP)
    assert command.refusal is not None
    assert says in str(command.refusal)
    assert command.hold_force_n is None
    assert play.grasp.phase is Phase.IDLE


def test_a_request_above_the_force_limit_is_refused() -> None:
    assert "130 N" in str(Play().step(RequestKind.GRASP, force_n=131.0).refusal)
    assert "130 N" in str(Play().held().step(RequestKind.GRIPPER, force_n=131.0).refusal)


def test_one_finger_will_do_after_the_time_out() -> None:
    play = Play()
    play.step(RequestKind.GRASP)
    play.step()
    play.view = fused(0.0, fingers=("left",), note="right finger: round contact")
    play.steps(0.9)
    assert play.grasp.phase is Phase.REFERENCE
    said = [command.text for command in play.steps(0.2) if command.text]
    assert play.grasp.phase is Phase.HOLDING
    assert said[0].startswith("holding with 40 N, rotation estimated by one finger only (right finger: round contact)")


def test_an_answer_from_before_the_grip_is_no_reference() -> None:
    play = Play()
    play.view = fused(0.0, at_s=90.0)
    play.lazy = True
    play.step(RequestKind.GRASP)
    play.steps(0.2)
    assert play.grasp.phase is Phase.REFERENCE


ROUND = "left finger: round contact; right finger: round contact"


def without_estimate(params: GuardParams) -> Play:
    play = Play(params)
    play.step(RequestKind.GRASP)
    play.step()
    play.view = fused(None, declined=ROUND)
    play.steps(1.1)
    assert play.grasp.phase is Phase.HOLDING
    return play


def has_said(play: Play, text: str) -> bool:
    return any(message.text == text for command in play.commands for message in command.messages)


def test_without_a_reference_it_grips_firmly_before_lifting() -> None:
    play = without_estimate(PARAMS)
    assert play.grasp.grip.target_n == pytest.approx(100.0, abs=0.85)
    assert has_said(play, f"no rotation estimate ({ROUND}): gripping with 100 N")
    assert play.grasp.held.no_estimate == ROUND
    assert isinstance(play.step(RequestKind.LIFT).arm, LiftArm)
    play.steps(3.0)
    assert play.grasp.phase is Phase.HOLDING  # no rotation is required if it never could be estimated


def test_without_a_reference_it_refuses_the_lift_with_a_reason() -> None:
    play = without_estimate(guard_params(on_no_estimate="refuse"))
    assert has_said(play, f"no rotation estimate ({ROUND})")
    assert play.grasp.grip.target_n == pytest.approx(40.0, abs=0.85)
    refused = str(play.step(RequestKind.LIFT).refusal)
    assert refused is not None
    assert "round contact" in refused


def test_without_an_estimate_a_firm_grip_or_one_near_a_person_is_kept() -> None:
    for force_n, here in ((110.0, arm()), (40.0, arm(protective=True))):
        state = state_in(Phase.REFERENCE, since_s=NOW_S - 5.0, target_n=force_n)
        view = seen_in(Phase.REFERENCE, gripper=gripper(force_n, at_s=NOW_S), arm=here, fused=None)
        state, command = step(state, view, PARAMS)
        assert state.phase is Phase.HOLDING
        assert state.held.no_estimate == "no frames from either finger"
        assert command.hold_force_n is None


def test_without_an_estimate_translational_slip_is_still_met() -> None:
    play = without_estimate(PARAMS)
    before_n = play.grasp.grip.target_n
    for number in range(9):
        play.view = changed(play.view, shift_mm=0.3 * number)
        play.step()
    assert play.grasp.grip.target_n > before_n


def test_a_lost_release_command_is_repeated_and_then_given_up() -> None:
    state, command = step(state_in(Phase.HOLDING), observation(NOW_S, request=ask(RequestKind.RELEASE)), PARAMS)
    opened = int(released_mm(command) is not None)
    for number in range(1, 150):
        now_s = NOW_S + 0.02 * number
        state, command = step(state, observation(now_s, gripper=gripper(40.0, at_s=now_s)), PARAMS)
        opened += released_mm(command) is not None
    assert opened > 5
    assert state.phase is Phase.FAULT
    assert state.fault is not None
    assert state.fault.code is FaultCode.NOT_RELEASED
    _, command = step(state, observation(NOW_S + 5.0, gripper=gripper(40.0)), PARAMS)
    assert released_mm(command) is None  # one request does not open the jaws for ever


def test_a_gripper_that_comes_back_late_does_not_open() -> None:
    state, _ = step(state_in(Phase.HOLDING), observation(NOW_S, request=ask(RequestKind.RELEASE)), PARAMS)
    state, _ = step(state, observation(NOW_S + 3.0, gripper=None), PARAMS)
    state, command = step(state, observation(NOW_S + 60.0, gripper=gripper(40.0, at_s=NOW_S + 60.0)), PARAMS)
    assert released_mm(command) is None


# --- a force limit for one object ---


def test_a_fragile_object_is_never_gripped_harder_than_requested() -> None:
    play = Play(guard_params(first_force_n=60.0))
    assert play.step(RequestKind.GRASP, force_limit_n=45.0).hold_force_n == pytest.approx(45.0, abs=0.85)
    play.step()
    play.view = fused()
    play.step()
    assert play.grasp.grip.limit_n == 45.0
    for rotation_deg in (4.0, 9.0, 16.0, 25.0, 36.0, 50.0):
        play.slips(rotation_deg, 60.0)
        play.steps(0.5)
        assert play.jaws.force_n <= 45.0
    assert play.grasp.fault is not None
    play.view = changed(play.view, rate_deg_s=0.0)
    play.step(RequestKind.CLEAR)
    assert play.grasp.grip.limit_n == 45.0
    play.step(RequestKind.RELEASE)
    play.jaws = gripper(0.0, holding=False, width_mm=85.0)
    play.steps(1.0)
    assert play.grasp.grip.limit_n is None
    assert play.step(RequestKind.GRASP).hold_force_n == pytest.approx(60.0, abs=0.85)


@pytest.mark.parametrize(
    ("values", "says"),
    [
        ({"force_limit_n": 140.0}, "140 N is above the force limit of 130 N"),
        ({"force_limit_n": 50.0, "force_n": 60.0}, "60 N is above the force limit of 50 N"),
        ({"force_limit_n": 15.0}, "the force limit of 15 N is below the 20 N"),
    ],
)
def test_a_force_limit_that_cannot_be_kept_is_refused(values: dict[str, float], says: str) -> None:
    command = Play().step(RequestKind.GRASP, **values)
    assert says in str(command.refusal)
    assert command.hold_force_n is None


def test_a_force_limit_that_is_not_lower_changes_nothing() -> None:
    assert PARAMS.limited(None) is PARAMS.limited(PARAMS.force_max_n) is PARAMS


# --- the estimate is lost while the object is carried ---


def lost(height_mm: float, params: GuardParams = PARAMS, **view: object) -> Play:
    """Held, carried to this height, and then without a rotation for more than a second."""
    play = Play(params).held()
    play.here = arm(height_mm)
    play.steps(0.5)
    play.view = changed(play.view, **({"rotation_deg": None, "sigma_deg": None, "declined": "too round"} | view))
    play.steps(1.2)
    assert play.grasp.fault is not None
    assert play.grasp.fault.code is FaultCode.ESTIMATE_UNTRUSTED
    return play


def test_a_carried_object_that_no_finger_can_follow_any_more_is_gripped_firmer() -> None:
    play = lost(50.0)
    assert play.grasp.grip.target_n == pytest.approx(100.0, abs=0.85)
    assert any("no rotation estimate (too round): gripping with 100 N" in (one.text or "") for one in play.commands)
    assert sum(one.hold_force_n is not None for one in play.commands) == 2  # the first grip and this one


@pytest.mark.parametrize(
    ("height_mm", "changes", "params"),
    [
        (2.0, {}, PARAMS),
        (50.0, {"rotation_deg": 0.0, "sigma_deg": 0.5, "declined": None, "conflict": "one is stuck"}, PARAMS),
        (50.0, {}, guard_params(no_estimate_force_n=40.0)),
    ],
    ids=["on the table", "contradiction", "no more force configured"],
)
def test_otherwise_the_force_stays(height_mm: float, changes: dict[str, object], params: GuardParams) -> None:
    assert lost(height_mm, params, **changes).grasp.grip.target_n == pytest.approx(40.0, abs=0.85)


@pytest.mark.parametrize(
    ("phase", "kind", "values", "verb"),
    [
        (Phase.IDLE, RequestKind.GRASP, {}, "grasp"),
        (Phase.IDLE, RequestKind.GRIPPER, {"width_mm": 40.0}, "move the jaws"),
        (Phase.IDLE, RequestKind.ACTIVATE, {}, "activate"),
        (Phase.FAULT, RequestKind.CLEAR, {}, "clear"),
    ],
)
def test_near_a_person_no_request_moves_the_jaws(
    phase: Phase, kind: RequestKind, values: dict[str, float], verb: str
) -> None:
    active = kind is not RequestKind.ACTIVATE
    jaws = gripper(0.0, holding=False, width_mm=85.0, active=active, at_s=NOW_S)
    seen = seen_in(phase, gripper=jaws, arm=arm(protective=True, at_s=NOW_S), request=ask(kind, **values))
    _, command = step(state_in(phase), seen, PARAMS)
    assert command.gripper is None
    assert str(command.refusal) == f"cannot {verb}: the arm is in a protective or emergency stop; end that first"


def test_clear_keeps_the_way_down() -> None:
    before = state_in(Phase.FAULT, ground_mm=10.0, start_mm=(300.0, 0.0, 10.0))
    state, command = step(before, seen_in(Phase.FAULT, request=ask(RequestKind.CLEAR)), PARAMS)
    assert command.refusal is None
    assert (state.phase, state.arm.ground_mm, state.arm.start_mm) == (Phase.REFERENCE, 10.0, (300.0, 0.0, 10.0))
