"""Supervisor and controller together: every phase against every failure, as a table."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from controller_steps import FAULT, NOW_S, PARAMS, seen_in, state_in
from observations import arm, ask, fused, gripper
from records import changed, moved_mm, released_mm

from slipguard.control.arm_motion import SAME_SLIP
from slipguard.control.control_step import ControlState, control_step
from slipguard.control.force_law import UNSETTLED_S
from slipguard.control.messages import Condition, FingerHealth, Observation, RequestKind, StepOutput, StopArm
from slipguard.control.release import OPEN_ANYWAY_S
from slipguard.control.reports import Fault, FaultCode
from slipguard.control.state import AT_STAKE, GraspState, Phase, SlipEpisode
from slipguard.control.supervisor import Supervision

TICK_S = 0.04
LASTS_S = 3.2
GONE = FingerHealth(Condition.LOST, 1.0, "unplugged")
DARK = FingerHealth(Condition.BLIND, 0.02, "image unusable: mean of 9 gray levels (minimum 25)")
NO_SIGHT = changed(fused(None, declined="image unusable", shift_mm=None), left_contact=None, right_contact=None)
SLIPS = SlipEpisode(NOW_S - 2.0, NOW_S - 2.0)
HELD = AT_STAKE - {Phase.CLOSING}
GUARDED = frozenset({Phase.LIFTING, Phase.HOLDING, Phase.LOWERING})
SEEN = GUARDED | {Phase.REFERENCE}
"""A rotation that is seen ends the wait for a reference, and is guarded from then on."""
View = Callable[[Observation, float], Observation]
"""What the event makes of what is seen in that phase; the time since it began."""


def rotating(view: Observation, since_s: float, rate_deg_s: float = 7.5) -> Observation:
    return changed(view, fused=fused(22.0 + rate_deg_s * since_s, rate_deg_s, at_s=view.now_s))


def rotating_while_it_tightens(view: Observation, since_s: float) -> Observation:
    return rotating(changed(view, gripper=view.gripper and changed(view.gripper, moving=True)), since_s, 10.0)


EVENTS: dict[FaultCode, tuple[View, frozenset[Phase], dict[str, object]]] = {
    FaultCode.FRAMES_LOST: (lambda view, _: changed(view, left=GONE, right=GONE, fused=None), AT_STAKE, {}),
    FaultCode.FINGERS_BLIND: (
        lambda view, _: changed(view, left=DARK, right=DARK, fused=changed(NO_SIGHT, captured_at_s=view.now_s)),
        AT_STAKE,
        {},
    ),
    FaultCode.ESTIMATE_UNTRUSTED: (
        lambda view, _: changed(view, fused=fused(None, declined="round contact", at_s=view.now_s)),
        GUARDED,
        {},
    ),
    FaultCode.GRIPPER_SILENT: (lambda view, _: changed(view, gripper=None), AT_STAKE, {}),
    FaultCode.GRIPPER_FAULT: (
        lambda view, _: changed(view, gripper=view.gripper and changed(view.gripper, fault="9")),
        AT_STAKE,
        {},
    ),
    FaultCode.ARM_SILENT: (lambda view, _: changed(view, arm=None), AT_STAKE, {}),
    FaultCode.ARM_STOPPED: (
        lambda view, _: changed(view, arm=arm(50.0, protective=True, at_s=view.now_s)),
        AT_STAKE,
        {},
    ),
    FaultCode.ARM_EMERGENCY: (
        lambda view, _: changed(view, arm=arm(50.0, emergency=True, at_s=view.now_s)),
        AT_STAKE,
        {},
    ),
    FaultCode.ARM_STUCK: (
        lambda view, _: changed(view, arm=arm(50.0, at_s=view.now_s)),
        frozenset({Phase.LIFTING, Phase.LOWERING}),
        {},
    ),
    FaultCode.TIGHTENING_INEFFECTIVE: (rotating_while_it_tightens, SEEN, {"slip": SLIPS, "target_n": 60.0}),
    FaultCode.FORCE_LIMIT_REACHED: (rotating, SEEN, {"slip": SLIPS, "target_n": 129.57}),
    FaultCode.ROTATED_TOO_FAR: (
        lambda view, since_s: changed(view, fused=fused(50.0 + 60.0 * since_s, 60.0, at_s=view.now_s)),
        SEEN,
        {"slip": SLIPS},
    ),
    FaultCode.NOT_SETTLED: (
        lambda view, since_s: changed(view, fused=fused(3.0 + 6.0 * (round(since_s / TICK_S) % 2), at_s=view.now_s)),
        GUARDED,
        {"slip": changed(SLIPS, tightened_s=NOW_S - UNSETTLED_S + 0.2), "target_n": 129.61},
    ),
    FaultCode.OBJECT_LOST: (
        lambda view, _: changed(view, gripper=gripper(40.0, holding=False, nothing=True, at_s=view.now_s)),
        HELD,
        {},
    ),
}


def before_in(phase: Phase, **changes: object) -> ControlState:
    """All well in that phase. changes: where slip may be under way."""
    guarded = phase in GUARDED or phase is Phase.FAULT
    grasp = state_in(phase, closed=phase in HELD or phase is Phase.FAULT, **(changes if guarded else {}))
    return ControlState(changed(grasp, referenced=guarded), Supervision(stepped_s=NOW_S - TICK_S, arm_known=True))


def moment(phase: Phase, now_s: float) -> Observation:
    """All as it should be in that phase, just measured."""
    view = seen_in(phase)
    moving_mm = 40.0 * (now_s - NOW_S) * {Phase.LIFTING: 1.0, Phase.LOWERING: -1.0}.get(phase, 0.0)
    opening_mm = 30.0 + (20.0 * (now_s - NOW_S) if phase is Phase.RELEASED else 0.0)
    return changed(
        view,
        now_s=now_s,
        gripper=view.gripper and changed(view.gripper, measured_at_s=now_s, width_mm=opening_mm),
        arm=view.arm and changed(view.arm, measured_at_s=now_s, height_mm=view.arm.height_mm + moving_mm),
        fused=view.fused and changed(view.fused, captured_at_s=now_s, measured_at_s=now_s),
    )


def play(phase: Phase, code: FaultCode) -> list[tuple[GraspState, StepOutput]]:
    view, _, changes = EVENTS[code]
    guard, played = before_in(phase, **changes), []
    for number in range(round(LASTS_S / TICK_S)):
        now_s = NOW_S + TICK_S * number
        guard, command = control_step(guard, view(moment(phase, now_s), TICK_S * number), PARAMS)
        played.append((guard.grasp, command))
    return played


def test_the_table_has_every_fault_that_lasts() -> None:
    at_once = {FaultCode.LOOP_LATE, FaultCode.MACHINE_BUSY}  # below
    at_once |= {FaultCode.GRIPPER_STUCK, FaultCode.NOT_RELEASED}
    assert set(EVENTS) | at_once == set(FaultCode)


@pytest.mark.parametrize("phase", Phase)
@pytest.mark.parametrize("code", EVENTS)
def test_phase_against_what_goes_wrong(phase: Phase, code: FaultCode) -> None:
    played = play(phase, code)
    said = "; ".join(command.text for _, command in played if command.text)
    assert all(moved_mm(command) is None for _, command in played)
    if phase is not Phase.RELEASED:  # there a command without effect is repeated
        assert all(released_mm(command) is None for _, command in played)
    if phase in EVENTS[code][1]:
        at = next(index for index, (state, _) in enumerate(played) if state.phase is Phase.FAULT)
        state, command = played[at]
        assert state.fault is not None
        assert command.fault == state.fault
        wrong = state.fault.code
        assert wrong is code or (phase is Phase.REFERENCE and {wrong, code} <= SAME_SLIP)
        assert str(state.fault) in said
        assert command.arm == StopArm()
        assert all(state.phase is Phase.FAULT and state.fault.code is wrong for state, _ in played[at:] if state.fault)
        assert all(state.grip.target_n >= played[0][0].grip.target_n for state, _ in played)
    elif phase is Phase.FAULT:
        assert all(state.phase is Phase.FAULT and state.fault == FAULT for state, _ in played)
        if code not in (FaultCode.ARM_STUCK, FaultCode.ARM_SILENT):
            assert said.count(f"{code.value}: ") == 1
    elif phase is Phase.RELEASED and code in (FaultCode.GRIPPER_SILENT, FaultCode.OBJECT_LOST):
        assert played[-1][0].fault is not None
        assert played[-1][0].fault.code is FaultCode.NOT_RELEASED  # it never says that it has opened
    else:
        assert all(state.phase is not Phase.FAULT for state, _ in played)
        assert f"{code.value}: " not in said


@pytest.mark.parametrize("phase", Phase)
def test_a_late_loop_in_every_phase(phase: Phase) -> None:
    guard, _ = control_step(before_in(phase), moment(phase, NOW_S), PARAMS)
    guard, command = control_step(guard, moment(phase, NOW_S + 0.6), PARAMS)
    latched = phase in AT_STAKE
    assert (guard.grasp.fault is not None and guard.grasp.fault.code is FaultCode.LOOP_LATE) is latched
    assert (command.arm == StopArm()) is latched
    assert ("loop late" in (command.text or "")) is (latched or phase is Phase.FAULT)


@pytest.mark.parametrize("code", EVENTS)
@pytest.mark.parametrize("phase", Phase)
def test_a_release_in_every_phase_and_every_fault(phase: Phase, code: FaultCode) -> None:
    view, _, changes = EVENTS[code]
    guard = before_in(phase, **changes)
    for number in range(30):
        now_s = NOW_S + TICK_S * number
        guard, _ = control_step(guard, view(moment(phase, now_s), TICK_S * number), PARAMS)
    asked = changed(view(moment(phase, now_s + TICK_S), 1.2), request=ask(RequestKind.RELEASE, width_mm=70.0))
    guard, command = control_step(guard, asked, PARAMS)
    assert guard.grasp.phase is Phase.RELEASED
    assert guard.grasp.fault is None
    assert (command.text or "").startswith("releasing, as requested")
    assert command.refusal is None
    waited_s = 0.0
    while released_mm(command) is None:
        assert command.arm == StopArm() or guard.grasp.release.arm_may_move
        waited_s += TICK_S
        guard, command = control_step(guard, view(moment(phase, now_s + TICK_S + waited_s), 1.2 + waited_s), PARAMS)
    assert released_mm(command) == 70.0
    assert waited_s <= OPEN_ANYWAY_S + TICK_S


@pytest.mark.parametrize("kind", [kind for kind in RequestKind if kind not in (RequestKind.NONE, RequestKind.RELEASE)])
@pytest.mark.parametrize("code", EVENTS)
def test_in_a_fault_only_a_release_request_moves_anything(code: FaultCode, kind: RequestKind) -> None:
    view, _, changes = EVENTS[code]
    guard = before_in(Phase.HOLDING, **changes)
    guard = changed(guard, grasp=changed(guard.grasp, phase=Phase.FAULT, fault=Fault(code, "seen", "do")))
    for number in range(30):
        now_s = NOW_S + TICK_S * number
        guard, _ = control_step(guard, view(moment(Phase.HOLDING, now_s), TICK_S * number), PARAMS)
    asked = changed(view(moment(Phase.HOLDING, now_s + TICK_S), 1.2), request=ask(kind))
    _, command = control_step(guard, asked, PARAMS)
    assert released_mm(command) is moved_mm(command) is None
    assert command.arm in (None, StopArm())
