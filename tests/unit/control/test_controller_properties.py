"""Properties of every sequence of observations, however improbable."""

from __future__ import annotations

from hypothesis import given, settings
from hypothesis import strategies as st
from observations import arm, ask, fused, gripper, guard_params, observation
from records import changed, grasp_state, moved_mm, released_mm

from slipguard.control.control_step import ControlState, control_step
from slipguard.control.messages import (
    Condition,
    ControlRequest,
    FingerHealth,
    LiftArm,
    Observation,
    RequestKind,
    StepOutput,
    StopArm,
)
from slipguard.control.params import GuardParams
from slipguard.control.release import OPEN_ANYWAY_S
from slipguard.control.reports import Fault, FaultCode
from slipguard.control.state import AT_STAKE, MOVING, Phase, Release

HELD = (AT_STAKE - {Phase.CLOSING}) | {Phase.FAULT}

requests = st.one_of(
    st.just(ControlRequest()),
    st.just(ControlRequest()),
    st.builds(ask, st.sampled_from([kind for kind in RequestKind if kind is not RequestKind.RELEASE])),
    st.builds(lambda n: ask(RequestKind.GRIPPER, force_n=n), st.floats(1.0, 235.0)),
    st.builds(lambda n: ask(RequestKind.GRASP, force_n=n), st.floats(1.0, 235.0)),
)
releases = st.builds(ask, st.just(RequestKind.RELEASE))
rotations = st.one_of(st.none(), st.floats(-90.0, 90.0))
views = st.one_of(
    st.none(),
    st.builds(
        fused, rotations, st.one_of(st.none(), st.floats(-400.0, 400.0)), contact=st.booleans(),
        shift_mm=st.one_of(st.none(), st.floats(-5.0, 5.0)), sigma_deg=st.floats(0.1, 6.0),
        conflict=st.one_of(st.none(), st.just("a conflict")),
    ),
)  # fmt: skip
jaws = st.one_of(
    st.none(),
    st.builds(
        gripper, st.floats(0.0, 120.0), holding=st.sampled_from([True, True, True, False]), moving=st.booleans(),
        nothing=st.sampled_from([False, False, False, True]), fault=st.sampled_from([None, None, None, "9"]),
        active=st.sampled_from([True, True, True, False]),
    ),
)  # fmt: skip
arms = st.one_of(
    st.none(),
    st.builds(
        arm, st.floats(0.0, 200.0), moving=st.booleans(), protective=st.sampled_from([False, False, False, True]),
        emergency=st.sampled_from([False, False, False, True]),
    ),
)  # fmt: skip
healths = st.builds(FingerHealth, st.sampled_from(Condition), st.floats(0.0, 1.0))
gaps = st.sampled_from([0.005, 0.01, 0.01, 0.02, 0.1, 0.4, 1.2])


def moment(
    gap_s: float, view: object, jaw: object, here: object, left: object, right: object
) -> tuple[float, Observation]:
    return gap_s, changed(observation(0.0), fused=view, gripper=jaw, arm=here, left=left, right=right)  # type: ignore[arg-type]


moments = st.builds(moment, gaps, views, jaws, arms, healths, healths)
modes = st.sampled_from(
    [GuardParams(), guard_params(mode="guard"), guard_params(on_no_estimate="refuse", stop_on_slip=False)]
)


def start(phase: Phase) -> ControlState:
    goal_mm = {Phase.LIFTING: 100.0, Phase.LOWERING: 0.0}.get(phase)
    release = Release(85.0) if phase is Phase.RELEASED else None
    held = phase not in (Phase.IDLE, Phase.RELEASED)
    fault = Fault(FaultCode.LOOP_LATE, "late", "look") if phase is Phase.FAULT else None
    state = grasp_state(
        phase, target_n=40.0 * held, referenced=held, ground_mm=0.0, goal_mm=goal_mm, release=release, fault=fault
    )
    return ControlState(changed(state, adopted=phase is not Phase.IDLE))


def play(
    guard: ControlState, story: list[tuple[tuple[float, Observation], ControlRequest]], params: GuardParams
) -> list[tuple[ControlState, Observation, StepOutput, ControlState]]:
    """Every tick: before, seen, command, after. Devices and fingers were read a little before the tick."""
    now_s, played = 0.0, []
    for (gap_s, view), request in story:
        now_s += gap_s
        view = changed(
            view, now_s=now_s, request=request,
            fused=view.fused and changed(view.fused, captured_at_s=now_s - 0.04, measured_at_s=now_s - 0.04),
            gripper=view.gripper and changed(view.gripper, measured_at_s=now_s - 0.003),
            arm=view.arm and changed(view.arm, measured_at_s=now_s - 0.003),
        )  # fmt: skip
        after, command = control_step(guard, view, params)
        played.append((guard, view, command, after))
        guard = after
    return played


stories = st.lists(st.tuples(moments, requests), min_size=1, max_size=40)
any_stories = st.lists(st.tuples(moments, st.one_of(requests, releases)), min_size=1, max_size=40)
phases = st.sampled_from(Phase)


@settings(max_examples=150)
@given(phases, stories, modes)
def test_without_a_request_to_release_nothing_opens_and_the_force_never_falls(
    phase: Phase, story: list[tuple[tuple[float, Observation], ControlRequest]], params: GuardParams
) -> None:
    guard = start(phase)
    for before, view, command, after in play(guard, story, params):
        if phase is not Phase.RELEASED:
            assert released_mm(command) is None
        if before.grasp.phase in HELD and after.grasp.phase in HELD and view.request.kind is not RequestKind.CLEAR:
            assert after.grasp.grip.target_n >= before.grasp.grip.target_n
            assert command.hold_force_n is None or command.hold_force_n >= before.grasp.grip.target_n
        if before.grasp.phase in HELD:
            assert moved_mm(command) is None


@settings(max_examples=150)
@given(phases, any_stories, modes)
def test_no_command_exceeds_the_force_limit_or_adds_force_near_a_person(
    phase: Phase, story: list[tuple[tuple[float, Observation], ControlRequest]], params: GuardParams
) -> None:
    for _, view, command, after in play(start(phase), story, params):
        for force_n in (getattr(command.gripper, "force_n", None),):
            assert force_n is None or force_n <= params.force_max_n
        if view.arm is not None and (view.arm.protective_stop or view.arm.emergency_stop):
            assert command.hold_force_n is None
            assert moved_mm(command) is None
            assert not isinstance(command.arm, LiftArm)
        if params.mode == "guard" and phase not in MOVING:  # no way leads there in this mode
            assert not isinstance(command.arm, LiftArm)
        assert (after.grasp.fault is not None) is (after.grasp.phase is Phase.FAULT)


@settings(max_examples=150)
@given(phases, any_stories, modes)
def test_a_fault_stops_the_arm_and_only_clear_or_release_leave_it(
    phase: Phase, story: list[tuple[tuple[float, Observation], ControlRequest]], params: GuardParams
) -> None:
    for before, view, command, after in play(start(phase), story, params):
        if after.grasp.phase is Phase.FAULT:
            assert not isinstance(command.arm, LiftArm)
            assert command.fault == after.grasp.fault
            if before.grasp.phase is not Phase.FAULT:
                assert command.arm == StopArm()
        elif before.grasp.phase is Phase.FAULT:
            assert view.request.kind in (RequestKind.CLEAR, RequestKind.RELEASE)


@settings(max_examples=100)
@given(phases, stories, moments, st.lists(moments, max_size=30), modes)
def test_a_release_is_granted_after_any_history(
    phase: Phase,
    story: list[tuple[tuple[float, Observation], ControlRequest]],
    last: tuple[float, Observation],
    then: list[tuple[float, Observation]],
    params: GuardParams,
) -> None:
    given = [*story, (last, ask(RequestKind.RELEASE)), *((one, ControlRequest()) for one in then)]
    asked, *later = play(start(phase), given, params)[len(story) :]
    assert asked[2].refusal is None
    assert asked[3].grasp.phase is Phase.RELEASED
    opened_s = None
    for _, view, command, _ in [asked, *later]:
        assert command.hold_force_n is moved_mm(command) is None
        if released_mm(command) is not None:
            assert released_mm(command) == params.release_width_mm
            opened_s = opened_s or view.now_s
        else:
            assert opened_s is not None or view.now_s - asked[1].now_s < OPEN_ANYWAY_S
