"""Rare events: an object found at the start, jaws in an unknown state, a gripper above the force limit."""

from __future__ import annotations

import pytest
from controller_steps import FAULT, NOW_S, PARAMS, seen_in, state_in
from observations import arm, ask, estimate, fused, gripper, observation
from records import changed, grasp_state, released_mm

from slipguard.control.control_step import step
from slipguard.control.finger_fusion import FusedEstimate, fuse
from slipguard.control.load_state import LoadState
from slipguard.control.messages import RequestKind, StopArm
from slipguard.control.state import GraspState, Phase, RememberedGrip, SlipEpisode
from slipguard.devices import GripperState


def test_what_is_found_held_waits_for_a_finger_but_not_for_the_arm() -> None:
    state, said = GraspState(), []
    for number in range(15):
        now_s = 100.0 + 0.1 * number
        view = observation(now_s, gripper=gripper(60.0, at_s=now_s), arm=None, fused=fused() if number > 10 else None)
        state, command = step(state, view, PARAMS)
        said += [(round(now_s - 100.0, 1), command.text)] if command.text else []
        assert command.hold_force_n is released_mm(command) is command.arm is None
    assert said[:2] == [
        (0.0, "an object is already held with 60 N: waiting for a finger"),
        (1.1, "an object is already held with 60 N: taken over as it is"),
    ]
    assert (state.phase, state.grip.target_n, state.grip.closed) == (Phase.REFERENCE, 60.0, True)


@pytest.mark.parametrize(("fingers", "here"), [(fused(), arm()), (fused(None, contact=False), arm())])
def test_with_finger_and_arm_it_is_taken_over_at_once(fingers: FusedEstimate, here: object) -> None:
    view = observation(100.0, gripper=gripper(60.0, at_s=100.0), arm=here, fused=fingers)
    state, _ = step(GraspState(), view, PARAMS)
    assert state.phase is Phase.REFERENCE


def test_a_greater_force_from_before_the_restart_is_reported() -> None:
    remembered = grasp_state(remembered=RememberedGrip(91.0, 30.0))
    _, command = step(remembered, observation(100.0, gripper=gripper(20.0, at_s=100.0)), PARAMS)
    assert command.text == "an object is already held with 20 N: taken over with the 91 N from before the restart"
    _, command = step(remembered, observation(100.0, gripper=gripper(95.0, at_s=100.0)), PARAMS)
    assert command.text == "an object is already held with 95 N: taken over as it is"
    unconfirmed = grasp_state(remembered=RememberedGrip(91.0, 30.0, applied=False))
    _, command = step(unconfirmed, observation(100.0, gripper=gripper(20.0, at_s=100.0)), PARAMS)
    again = "taken over; the 92 N requested before the restart are commanded again"
    assert command.text == f"an object is already held with 20 N: {again}"


@pytest.mark.parametrize(
    ("jaws", "says"),
    [
        (gripper(40.0), "an object is already held"),
        (gripper(0.0, holding=False, active=False), "the gripper is not ready (not activated; "),
        (gripper(0.0, holding=False, fault="9"), "the gripper is not ready (9)"),
        (None, "the gripper is not connected"),
    ],
)
def test_a_grasp_is_refused_with_a_reason(jaws: GripperState | None, says: str) -> None:
    state, command = step(
        state_in(Phase.IDLE), seen_in(Phase.IDLE, gripper=jaws, request=ask(RequestKind.GRASP)), PARAMS
    )
    assert says in str(command.refusal)
    assert command.hold_force_n is None
    assert state.phase is Phase.IDLE


ALWAYS_GRANTED = (RequestKind.RELEASE, RequestKind.STOP)
REQUESTS = [kind for kind in RequestKind if kind not in (RequestKind.NONE, *ALWAYS_GRANTED)]


@pytest.mark.parametrize("kind", REQUESTS)
def test_a_request_in_the_step_of_a_fault_is_refused(kind: RequestKind) -> None:
    seen = seen_in(Phase.HOLDING, fault=FAULT, request=ask(kind))
    state, command = step(state_in(Phase.HOLDING), seen, PARAMS)
    assert (state.phase, command.fault) == (Phase.FAULT, FAULT)
    assert str(command.refusal) == "a fault is latched (arm silent); clear it first"
    assert step(state_in(Phase.HOLDING), seen_in(Phase.HOLDING, fault=FAULT), PARAMS)[1].refusal is None


@pytest.mark.parametrize("kind", REQUESTS)
def test_a_request_in_the_step_in_which_the_closing_takes_too_long_is_refused(kind: RequestKind) -> None:
    seen = seen_in(Phase.CLOSING, request=ask(kind))
    state, command = step(state_in(Phase.CLOSING, since_s=NOW_S - 60.0), seen, PARAMS)
    assert state.phase is Phase.FAULT, "a `clear` does not end a fault that nothing has reported yet"
    assert str(command.refusal) == "a fault is latched (gripper stuck); clear it first"


@pytest.mark.parametrize(
    ("jaws", "phase", "says"),
    [
        (gripper(40.0, holding=False, moving=True), Phase.FAULT, "the gripper is moving"),
        (gripper(40.0, holding=True, moving=True), Phase.REFERENCE, ""),
        (gripper(40.0, holding=False), Phase.IDLE, ""),
    ],
)
def test_clear_needs_to_know_what_is_held(jaws: GripperState, phase: Phase, says: str) -> None:
    state, command = step(
        state_in(Phase.FAULT), seen_in(Phase.FAULT, gripper=jaws, request=ask(RequestKind.CLEAR)), PARAMS
    )
    assert state.phase is phase
    assert says in str(command.refusal)
    assert (command.refusal is None) is (says == "")


def test_a_gripper_above_the_force_limit_is_never_commanded_to_tighten() -> None:
    view = seen_in(Phase.HOLDING, fused=fused(20.0, 40.0, at_s=NOW_S), gripper_limits_n=(150.0, 235.0))
    state = state_in(Phase.HOLDING)
    for number in range(10):
        now_s = NOW_S + 0.02 * number
        state, command = step(state, changed(view, now_s=now_s, fused=fused(20.0, 40.0, at_s=now_s)), PARAMS)
        assert command.hold_force_n is None
    assert state.held.slip is not None
    assert command.arm in (StopArm(), None)


@pytest.mark.parametrize(
    "bad",
    [
        {"rotation_deg": float("nan")},
        {"rotation_deg": float("inf")},
        {"rotation_deg": 2e6},
        {"sigma_deg": float("nan")},
        {"sigma_deg": -0.1},
        {"sigma_deg": 181.0},
        {"rate_deg_s": float("nan")},
        {"shift_mm": (0.0, float("nan"))},
        {"shift_mm": (float("-inf"), 0.0)},
    ],
)
def test_an_invalid_number_gives_no_rotation(bad: dict[str, object]) -> None:
    one = changed(estimate(3.0, 0.5, shift_mm=(0.0, 0.0)), **bad)  # type: ignore[arg-type]
    answer = fuse(one, None)
    assert answer is not None
    assert answer.rotation_deg is answer.sigma_deg is answer.rate_deg_s is answer.shift_mm is None
    assert "left finger: not a number" in (answer.declined or "")
    with_right = fuse(one, estimate(-4.0, 0.5))
    assert with_right is not None
    assert (with_right.rotation_deg, with_right.fingers) == (4.0, ("right",))


@pytest.mark.parametrize("bad", [{"captured_at_s": float("nan")}, {"measured_at_s": float("inf")}])
def test_without_a_time_a_finger_gives_nothing(bad: dict[str, float]) -> None:
    one = changed(estimate(3.0, 0.5), **bad)  # type: ignore[arg-type]
    assert fuse(one, None) is None
    with_right = fuse(one, estimate(-4.0, 0.5))
    assert with_right is not None
    assert (with_right.left_contact, with_right.fingers) == (None, ("right",))


@pytest.mark.parametrize("sigma_deg", [0.0, 180.0])
def test_the_ends_of_what_a_sigma_may_be(sigma_deg: float) -> None:
    answer = fuse(estimate(3.0, sigma_deg), None)
    assert answer is not None
    assert answer.rotation_deg == 3.0


def test_no_force_is_added_to_a_found_object_while_a_person_may_be_near() -> None:
    state = grasp_state(person_near=True)
    for number in range(100):
        now_s = 100.0 + 0.02 * number
        view = observation(
            now_s, gripper=gripper(60.0, at_s=now_s), arm=None, fused=fused(0.25 * number, 12.0, at_s=now_s)
        )
        state, command = step(state, view, PARAMS)
        assert command.hold_force_n is None
    assert state.phase is Phase.HOLDING
    near = state
    for here, given in ((arm(protective=True), False), (arm(), True)):
        state = near
        for number in range(100, 140):
            now_s = 100.0 + 0.02 * number
            view = observation(now_s, gripper=gripper(60.0, at_s=now_s), fused=fused(0.25 * number, 12.0, at_s=now_s))
            state, command = step(state, changed(view, arm=changed(here, measured_at_s=now_s)), PARAMS)
            if command.hold_force_n is not None:
                break
        assert (command.hold_force_n is not None) is given


def test_guard_off_ends_an_episode_of_slip() -> None:
    slipping = state_in(Phase.HOLDING, slip=SlipEpisode(NOW_S - 1.0, NOW_S - 1.0))
    state, command = step(slipping, seen_in(Phase.HOLDING, request=ask(RequestKind.GUARD_OFF)), PARAMS)
    assert (state.held.slip, state.guarding, state.held.load) == (None, False, LoadState())
    assert (command.text or "").endswith("; not guarding: slip has no effect on grip and arm")
