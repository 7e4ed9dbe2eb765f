"""After a restart: a force that was only commanded, a latched fault, and devices that do not come back."""

from __future__ import annotations

import pytest
from controller_steps import FAULT, PARAMS, Play
from observations import arm, fused, gripper, observation
from records import changed, grasp_state, released_mm

from slipguard.control.control_step import ControlState, control_step, step
from slipguard.control.messages import Condition, FingerHealth, LiftArm, Observation, RequestKind, StepOutput, StopArm
from slipguard.control.reports import Fault, FaultCode
from slipguard.control.state import Phase, RememberedGrip, force_applied
from slipguard.control.supervisor import DEVICE_START_S
from slipguard.devices import ArmState, GripperState

WIDTH_MM = gripper().width_mm
NEVER = FingerHealth(Condition.LOST, float("inf"), "unplugged")
ASKED = RememberedGrip(110.0, WIDTH_MM, applied=False)
ASKED_N = pytest.approx(110.0, abs=0.85)


def restarted(before: RememberedGrip | None, **changes: object) -> Play:
    """A new controller for an object that is held with 40 N."""
    grasp = grasp_state(remembered=before, **changes)  # type: ignore[arg-type]
    play = Play(guard=ControlState(grasp))
    play.jaws, play.view, play.here = gripper(40.0), fused(), arm(60.0)
    return play


def forces(commands: list[StepOutput]) -> list[float]:
    return [command.hold_force_n for command in commands if command.hold_force_n is not None]


# --- a force that was only commanded ---


def test_a_force_that_never_arrived_is_commanded_once_more() -> None:
    play = restarted(ASKED)
    first = play.step()
    assert "the 110 N requested before the restart are commanded again" in (first.text or "")
    assert forces(play.steps(1.0)) == [ASKED_N]
    assert play.grasp.phase is Phase.HOLDING
    assert play.grasp.grip.target_n == ASKED_N
    assert all(released_mm(command) is None for command in play.commands)
    assert play.slips().hold_force_n == pytest.approx(130.0, abs=0.85)


def test_one_that_arrived_after_all_is_not() -> None:
    play = restarted(ASKED)
    play.jaws = gripper(110.5)
    assert play.step().text == "an object is already held with 110 N: taken over as it is"
    assert forces(play.steps(1.0)) == []
    assert play.grasp.grip.target_n == 110.5


@pytest.mark.parametrize(
    ("before", "limits_n"),
    [
        (RememberedGrip(110.0, WIDTH_MM + 1.5, applied=False), (20.0, 235.0)),  # something else
        (RememberedGrip(30.0, WIDTH_MM, applied=False), (20.0, 235.0)),  # no more than there is
        (ASKED, (150.0, 235.0)),  # a gripper too strong for the force limit
    ],
)
def test_it_is_repeated_only_for_the_same_object_and_only_upwards(
    before: RememberedGrip, limits_n: tuple[float, float]
) -> None:
    state, given = grasp_state(remembered=before), []
    for number in range(50):
        now_s = 100.0 + 0.02 * number
        view = observation(now_s, gripper_limits_n=limits_n)
        state, command = step(state, view, PARAMS)
        given.append(command)
    assert forces(given) == []
    assert state.grip.target_n == 40.0


def test_it_is_repeated_within_the_present_force_limit() -> None:
    play = restarted(RememberedGrip(800.0, WIDTH_MM, applied=False))
    assert forces(play.steps(1.0)) == [pytest.approx(PARAMS.force_max_n, abs=0.85)]


def test_it_is_not_repeated_while_a_person_may_be_near() -> None:
    play = restarted(ASKED, person_near=True)
    play.here = None
    assert forces(play.steps(0.4)) == []
    play.here = arm(60.0, protective=True)
    assert forces(play.steps(1.0)) == []
    play.here = arm(60.0)
    assert forces(play.steps(0.4)) == [], "a hand may still be there"
    play.step(RequestKind.CLEAR)
    assert forces(play.steps(0.4)) == [ASKED_N]


@pytest.mark.parametrize(
    ("jaws", "is_taken"),
    [
        (gripper(109.6, at_s=10.1), True),
        (gripper(109.4, at_s=10.1), False),
        (gripper(110.0, at_s=10.0), False),  # said before it was given
        (gripper(110.0, at_s=10.1, moving=True), False),
    ],
)
def test_a_force_is_applied_once_the_gripper_confirms_it_at_rest(jaws: GripperState, is_taken: bool) -> None:
    held = grasp_state(Phase.HOLDING, target_n=110.0, commanded_s=10.0)
    assert force_applied(held, jaws) is is_taken
    assert force_applied(changed(held, commanded_s=float("-inf")), jaws), "no command was sent since the restart"


def test_jaws_still_on_their_way_are_waited_for() -> None:
    """A tightening that was under way as the daemon was killed."""
    play = restarted(RememberedGrip(93.0, WIDTH_MM))
    play.jaws = gripper(0.0, holding=False, moving=True)
    play.steps(0.2)
    assert (play.grasp.phase, play.grasp.adoption.done) == (Phase.IDLE, False)
    play.jaws = gripper(20.0)
    play.steps(0.6)
    assert (play.grasp.phase, play.grasp.grip.target_n) == (Phase.HOLDING, 93.0)


# --- a latched fault ---


def latched(before: RememberedGrip | None = ASKED, **changes: object) -> Play:
    return restarted(before, phase=Phase.FAULT, fault=FAULT, **changes)


def test_a_fault_stays_latched_until_it_is_cleared() -> None:
    play = latched(RememberedGrip(93.0, WIDTH_MM))
    play.jaws = gripper(20.0)
    first = play.step()
    assert first.fault is FAULT
    assert first.text == ("an object is already held with 20 N: taken over with the 93 N from before the restart")
    assert "a fault is latched (arm silent)" in str(play.step(RequestKind.LIFT).refusal)
    play.steps(1.0)
    assert (play.grasp.phase, play.grasp.grip.target_n, play.grasp.grip.closed) == (Phase.FAULT, 93.0, True)
    assert "cleared; holding with 93 N" in (play.step(RequestKind.CLEAR).text or "")
    play.steps(0.5)
    assert (play.grasp.phase, play.grasp.grip.target_n, play.grasp.fault) == (Phase.HOLDING, 93.0, None)
    assert forces(play.commands) == []


def test_a_release_ends_it() -> None:
    play = latched()
    play.step(RequestKind.RELEASE)
    assert (play.grasp.phase, play.grasp.fault) == (Phase.RELEASED, None)


def test_the_arm_stands_and_a_slip_is_answered_as_before_the_restart() -> None:
    play = latched(RememberedGrip(40.0, WIDTH_MM))
    play.here = arm(60.0, moving=True)
    assert StopArm() in [command.arm for command in play.steps(0.3)]
    play.here = arm(60.0)
    play.steps(0.5)
    assert (play.slips().hold_force_n or 0.0) > 40.0
    play.slips(50.0, 50.0)
    assert play.grasp.grip.target_n == pytest.approx(130.0, abs=0.85)
    assert any("rotated too far" in (command.text or "") for command in play.commands)


def test_a_force_that_never_arrived_is_repeated_in_a_fault_too() -> None:
    play = latched()
    assert forces(play.steps(0.5)) == [ASKED_N]
    assert play.grasp.phase is Phase.FAULT


def test_in_a_fault_adoption_waits_for_no_finger_and_has_no_reference_yet() -> None:
    play = latched(RememberedGrip(93.0, WIDTH_MM))
    play.view = None  # type: ignore[assignment]
    play.lazy = True
    play.step()
    assert (play.grasp.grip.target_n, play.grasp.held.referenced) == (93.0, False)
    play.view = fused(None, declined="no reference yet")
    play.lazy = False
    play.step()
    assert not play.grasp.held.referenced
    play.view = fused()
    play.step()
    assert play.grasp.held.referenced


@pytest.mark.parametrize("before", [None, RememberedGrip(93.0, WIDTH_MM)])
def test_with_empty_jaws_it_is_still_a_fault(before: RememberedGrip | None) -> None:
    play = latched(before)
    play.jaws = None  # type: ignore[assignment]
    play.steps(0.1)
    assert not play.grasp.adoption.done
    play.jaws = gripper(0.0, holding=False)
    play.steps(0.5)
    assert (play.grasp.phase, play.grasp.grip.closed, play.grasp.adoption.remembered) == (Phase.FAULT, False, None)
    assert play.step(RequestKind.CLEAR).text == "cleared; nothing is held"


def test_after_a_release_request_nothing_is_adopted() -> None:
    play = latched(release_requested=True)
    play.steps(0.5)
    play.slips(20.0, 50.0)
    assert forces(play.commands) == []
    assert not play.grasp.grip.closed


# --- what does not come back ---


def waits(
    view: Observation, seconds: float, before: RememberedGrip | None = ASKED
) -> tuple[ControlState, list[tuple[float, StepOutput]]]:
    guard, given = ControlState(grasp_state(remembered=before)), []
    for number in range(round(seconds / 0.05)):
        now_s = 100.0 + 0.05 * number
        jaws = view.gripper and changed(view.gripper, measured_at_s=now_s)
        here = view.arm and changed(view.arm, measured_at_s=now_s)
        guard, command = control_step(guard, changed(view, now_s=now_s, gripper=jaws, arm=here), PARAMS)
        given.append((now_s - 100.0, command))
    return guard, given


@pytest.mark.parametrize(
    ("view", "code"),
    [
        (observation(100.0, fused=None, left=NEVER, right=NEVER), FaultCode.FRAMES_LOST),
        (observation(100.0, gripper=None), FaultCode.GRIPPER_SILENT),
    ],
)
def test_what_never_comes_back_is_a_fault_as_while_holding(view: Observation, code: FaultCode) -> None:
    moving = changed(view, arm=arm(60.0, moving=True))
    guard, given = waits(moving, DEVICE_START_S - 0.05)
    assert guard.grasp.phase is Phase.IDLE
    guard, given = waits(moving, 4.0)
    latched_s, latching = next((at_s, command) for at_s, command in given if command.fault is not None)
    assert latched_s == pytest.approx(DEVICE_START_S, abs=0.06)
    assert latching.fault is not None
    assert latching.fault.code is code
    assert latching.arm == StopArm()
    assert [command.arm for _, command in given[-4:]].count(StopArm()) >= 1, "until it stands"
    # It comes back: the object is taken over with the force of before, and the fault stays until it is cleared.
    play = Play(guard=guard)
    play.now_s = 110.0
    play.jaws, play.view, play.here = gripper(40.0), fused(), arm(60.0)
    assert forces(play.steps(0.5)) == [ASKED_N]
    assert (play.grasp.phase, play.grasp.grip.target_n) == (Phase.FAULT, ASKED_N)
    play.step(RequestKind.CLEAR)
    play.steps(0.5)
    assert play.grasp.phase is Phase.HOLDING


@pytest.mark.parametrize("received", [True, False])
def test_a_finger_received_since_the_start_has_the_usual_timeout(received: bool) -> None:
    guard, silent_s = ControlState(grasp_state(remembered=ASKED)), 0.0
    while guard.grasp.phase is Phase.IDLE:
        gone = changed(NEVER, age_s=silent_s) if received else NEVER
        guard, _ = control_step(guard, observation(100.0 + silent_s, fused=None, left=gone, right=NEVER), PARAMS)
        silent_s += 0.05
    assert guard.grasp.fault is not None
    assert guard.grasp.fault.code is FaultCode.FRAMES_LOST
    assert silent_s == pytest.approx(PARAMS.tuning.frames_timeout_s if received else DEVICE_START_S, abs=0.06)


def test_a_gripper_received_since_the_start_has_the_usual_timeout() -> None:
    grasp = grasp_state(remembered=ASKED)
    guard, _ = control_step(
        ControlState(grasp), observation(99.9, gripper=gripper(0.0, holding=False, moving=True, at_s=99.9)), PARAMS
    )
    latched_s = 0.0
    while guard.grasp.phase is Phase.IDLE:
        latched_s += 0.05
        guard, _ = control_step(guard, observation(99.9 + latched_s, gripper=None), PARAMS)
    assert guard.grasp.fault is not None
    assert guard.grasp.fault.code is FaultCode.GRIPPER_SILENT
    assert latched_s == pytest.approx(PARAMS.tuning.gripper_timeout_s, abs=0.06)


def test_a_gripper_at_fault_is_one_at_once() -> None:
    guard, _ = control_step(
        ControlState(grasp_state(remembered=ASKED)),
        observation(100.0, gripper=gripper(0.0, fault="9", at_s=100.0)),
        PARAMS,
    )
    assert guard.grasp.fault is not None
    assert guard.grasp.fault.code is FaultCode.GRIPPER_FAULT


def test_with_nothing_remembered_nothing_is_missed() -> None:
    for view in (observation(100.0, fused=None, left=NEVER, right=NEVER), observation(100.0, gripper=None)):
        guard, _ = waits(view, 4.0, None)
        assert guard.grasp.phase is Phase.IDLE
    guard, command = control_step(
        ControlState(grasp_state(remembered=ASKED)),
        observation(100.0, gripper=gripper(0.0, holding=False, at_s=100.0)),
        PARAMS,
    )
    assert (guard.grasp.adoption.remembered, command.fault) == (None, None)


# --- what is not known after a restart ---

START_MM = (400.0, -100.0, 250.0)
LIFTED = RememberedGrip(93.0, WIDTH_MM, lift_start_mm=START_MM)


def at(x_mm: float, y_mm: float, z_mm: float) -> ArmState:
    """An arm whose heights count from where it is found after the restart."""
    return changed(arm(0.0), position_mm=(x_mm, y_mm, z_mm))


def test_an_unknown_force_is_reported_as_unknown() -> None:
    play = restarted(RememberedGrip(93.0, WIDTH_MM))
    play.jaws = gripper(20.0, known=False)
    said = [play.step().text, *(command.text for command in play.steps(0.5))]
    assert said[0] == (
        "an object is already held with an unknown force of at least 20 N: taken over with the 93 N from before the "
        "restart"
    )
    assert "holding with 93 N, rotation estimated" in said
    other = restarted(None)
    other.jaws = gripper(20.0, known=False)
    assert "holding with an unknown force of at least 20 N, rotation estimated" in [
        command.text for command in other.steps(0.5)
    ]


@pytest.mark.parametrize("fault", [None, FAULT])
def test_the_object_is_lowered_to_where_its_lift_began_before_the_restart(fault: Fault | None) -> None:
    play = restarted(LIFTED) if fault is None else latched(LIFTED)
    play.here = at(401.0, -101.0, 263.6)
    play.steps(0.5)
    if fault is not None:
        play.step(RequestKind.CLEAR)
        play.steps(0.5)
    assert play.grasp.arm.ground_mm == pytest.approx(-13.6)
    lowering = play.step(RequestKind.LOWER)
    assert (lowering.text, lowering.refusal) == ("lowering by 14 mm", None)
    assert isinstance(lowering.arm, LiftArm)
    assert lowering.arm.height_mm == pytest.approx(-13.6)


@pytest.mark.parametrize(
    ("before", "here"),
    [
        (LIFTED, at(410.0, -100.0, 263.6)),  # moved to one side
        (LIFTED, arm(0.0)),  # an arm that reports no position
        (changed(LIFTED, width_mm=WIDTH_MM + 1.5), at(*START_MM)),  # another object
        (changed(LIFTED, lift_start_mm=None), at(*START_MM)),
        (None, at(*START_MM)),
    ],
)
def test_the_way_down_is_unknown_if_the_arm_does_not_show_it(before: RememberedGrip | None, here: ArmState) -> None:
    play = restarted(before)
    play.here = here
    play.steps(0.5)
    assert play.grasp.arm.ground_mm is None
    assert "the way down is unknown" in str(play.step(RequestKind.LOWER).refusal)


def test_the_way_down_is_known_again_when_the_arm_is_back_above_the_start() -> None:
    play = restarted(LIFTED)
    play.here = at(400.0, -100.0, 263.6)
    play.steps(0.5)
    play.here = at(420.0, -100.0, 263.6)
    play.step()
    assert play.grasp.arm.ground_mm is None
    play.here = None  # type: ignore[assignment]
    play.step()
    play.here = at(400.0, -100.0, 280.0)
    play.step()
    assert play.grasp.arm.ground_mm == pytest.approx(-30.0)


def test_where_a_lift_began_is_remembered_for_a_restart() -> None:
    play = Play().held()
    play.here = changed(arm(5.0), position_mm=START_MM)
    play.step()
    assert play.grasp.arm.start_mm is None
    play.step(RequestKind.LIFT)
    assert (play.grasp.arm.ground_mm, play.grasp.arm.start_mm) == (5.0, START_MM)


def test_what_the_gripper_no_longer_reports_is_named() -> None:
    play = restarted(RememberedGrip(110.0, WIDTH_MM))
    play.jaws = gripper(0.0, holding=False)
    first = play.step()
    assert (first.text, first.is_warning) == (
        f"before the restart an object was held with 110 N at {WIDTH_MM:.0f} mm; the gripper reports none now",
        True,
    )
    assert (play.grasp.phase, play.grasp.adoption.remembered, play.step().text) == (Phase.IDLE, None, None)


def test_jaws_that_close_while_the_controller_starts_are_waited_for() -> None:
    play = restarted(None)
    play.jaws = gripper(0.0, holding=False, moving=True)
    assert not any(command.text for command in play.steps(0.5))
    play.jaws = gripper(40.0)
    play.step()
    assert play.grasp.phase in (Phase.REFERENCE, Phase.HOLDING)


def test_a_force_limit_for_one_object_outlasts_a_restart() -> None:
    known = RememberedGrip(40.0, WIDTH_MM, limit_n=50.0)
    for play in (restarted(known), latched(known)):
        play.steps(0.5)
        assert play.grasp.grip.limit_n == 50.0
        for rotation_deg in (4.0, 9.0, 16.0):
            play.slips(rotation_deg, 60.0)
            play.steps(0.5)
        assert 40.0 < play.jaws.force_n <= 50.0
    other = restarted(RememberedGrip(40.0, WIDTH_MM + 1.5, limit_n=50.0))
    other.steps(0.5)
    assert other.grasp.grip.limit_n is None
