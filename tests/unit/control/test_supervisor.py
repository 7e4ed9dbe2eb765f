"""Every fault of the supervisor: reported in time, with values, and no longer reported once it has passed."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from observations import arm, fused, gripper, observation
from records import changed, grasp_state, load_state

from slipguard.control.messages import Condition, FingerHealth, Observation
from slipguard.control.params import GuardParams
from slipguard.control.reports import Fault, FaultCode
from slipguard.control.state import AT_STAKE, GraspState, Phase, SlipEpisode
from slipguard.control.supervisor import Supervision, supervise

PARAMS = GuardParams()
TICK_S = 0.01
KNOWN = Supervision(arm_known=True, gripper_known=True, frames_known=True)
HOLDING = grasp_state(phase=Phase.HOLDING, referenced=True, target_n=40.0)
LIFTING = grasp_state(phase=Phase.LIFTING, referenced=True, target_n=40.0, goal_mm=100.0, ground_mm=0.0)
SLIPPING = grasp_state(phase=Phase.HOLDING, referenced=True, slip=SlipEpisode(0.0, 0.0))
LOST = FingerHealth(Condition.LOST, 0.5, "unplugged")
STALE = FingerHealth(Condition.STALE, 0.2, "frozen")


def first_fault(
    state: GraspState, view: Callable[[float], Observation], seconds: float = 3.0, params: GuardParams = PARAMS
) -> tuple[float, Fault | None]:
    """When the supervisor first says something, and what."""
    memory = KNOWN
    ticks = round(seconds / TICK_S)
    for number in range(ticks):
        now_s = number * TICK_S
        memory, faults = supervise(memory, state, view(now_s), params)
        if faults:
            return now_s, faults[0]
    return seconds, None


CASES: list[tuple[str, GraspState, Callable[[float], Observation], FaultCode | None, float]] = [
    ("all well", HOLDING, observation, None, 3.0),
    (
        "protective stop",
        HOLDING,
        lambda t: observation(t, arm=arm(at_s=t, protective=True)),
        FaultCode.ARM_STOPPED,
        0.0,
    ),
    (
        "emergency stop",
        HOLDING,
        lambda t: observation(t, arm=arm(at_s=t, emergency=True)),
        FaultCode.ARM_EMERGENCY,
        0.0,
    ),
    ("gripper gone", HOLDING, lambda t: observation(t, gripper=None), FaultCode.GRIPPER_SILENT, 0.4),
    ("gripper silent", HOLDING, lambda t: observation(t, gripper=gripper(at_s=0.0)), FaultCode.GRIPPER_SILENT, 0.4),
    (
        "gripper fault",
        HOLDING,
        lambda t: observation(t, gripper=gripper(at_s=t, fault="9")),
        FaultCode.GRIPPER_FAULT,
        0.0,
    ),
    (
        "not active",
        HOLDING,
        lambda t: observation(t, gripper=gripper(at_s=t, active=False)),
        FaultCode.GRIPPER_FAULT,
        0.0,
    ),
    ("arm gone", HOLDING, lambda t: observation(t, arm=None), FaultCode.ARM_SILENT, 0.4),
    ("arm silent", HOLDING, lambda t: observation(t, arm=arm(at_s=0.0)), FaultCode.ARM_SILENT, 0.4),
    ("both lost", HOLDING, lambda t: observation(t, left=LOST, right=STALE), FaultCode.FRAMES_LOST, 0.3),
    ("one lost", HOLDING, lambda t: observation(t, left=LOST), None, 3.0),
    (
        "conflict",
        HOLDING,
        lambda t: observation(t, fused=fused(at_s=t, conflict="x")),
        FaultCode.ESTIMATE_UNTRUSTED,
        1.0,
    ),
    (
        "shifts contradict",
        HOLDING,
        lambda t: observation(t, fused=changed(fused(at_s=t), shift_conflict="x")),
        FaultCode.ESTIMATE_UNTRUSTED,
        1.0,
    ),
    (
        "shifts contradict in a grip that was tightened",
        grasp_state(phase=Phase.HOLDING, referenced=True, target_n=40.0, load=load_state(tightened=True)),
        lambda t: observation(t, fused=changed(fused(at_s=t), shift_conflict="x")),
        None,
        3.0,
    ),
    (
        "conflict in a grip that was tightened",
        grasp_state(phase=Phase.HOLDING, referenced=True, target_n=40.0, load=load_state(tightened=True)),
        lambda t: observation(t, fused=fused(at_s=t, conflict="x")),
        FaultCode.ESTIMATE_UNTRUSTED,
        1.0,
    ),
    ("blind", HOLDING, lambda t: observation(t, fused=fused(None, declined="y")), FaultCode.ESTIMATE_UNTRUSTED, 1.0),
    (
        "blind from the start",
        grasp_state(phase=Phase.HOLDING, no_estimate="round"),
        lambda t: observation(t, fused=fused(None, declined="y")),
        None,
        3.0,
    ),
    (
        "blind and not guarding",
        grasp_state(phase=Phase.HOLDING, referenced=True, guarding=False),
        lambda t: observation(t, fused=fused(None, declined="y")),
        None,
        3.0,
    ),
    ("no answers yet", HOLDING, lambda t: observation(t, fused=None), None, 3.0),
    ("lifting", LIFTING, lambda t: observation(t, arm=arm(20.0 * t, moving=True, at_s=t)), None, 3.0),
    ("arm stuck", LIFTING, lambda t: observation(t, arm=arm(7.0, at_s=t)), FaultCode.ARM_STUCK, 2.0),
    (
        "paused",
        grasp_state(Phase.LIFTING, slip=SLIPPING.held.slip),
        lambda t: observation(t, arm=arm(7.0, at_s=t)),
        None,
        3.0,
    ),
    (
        "tightening has no effect",
        SLIPPING,
        lambda t: observation(t, fused=fused(-10.0 * t, -10.0, at_s=t)),
        FaultCode.TIGHTENING_INEFFECTIVE,
        1.5,
    ),
    (
        "helps late",
        SLIPPING,
        lambda t: observation(t, fused=fused(min(10 * t, 14.0), 10.0 * (t < 1.4), at_s=t)),
        None,
        3.0,
    ),
    ("hardly moves", SLIPPING, lambda t: observation(t, fused=fused(1.0 * t, 10.0, at_s=t)), None, 3.0),
    ("slips unseen", SLIPPING, lambda t: observation(t, fused=fused(None, at_s=t)), None, 3.0),
]


@pytest.mark.parametrize(("name", "state", "view", "code", "after_s"), CASES, ids=[case[0] for case in CASES])
def test_faults(
    name: str, state: GraspState, view: Callable[[float], Observation], code: FaultCode | None, after_s: float
) -> None:
    at_s, fault = first_fault(state, view)
    assert (fault.code if fault is not None else None) == code
    assert at_s == pytest.approx(after_s, abs=2 * TICK_S)
    if fault is not None:
        assert fault.observed
        assert fault.what_to_do
        assert "\n" not in str(fault)


def test_a_late_loop_is_a_fault() -> None:
    memory, faults = supervise(Supervision(), HOLDING, observation(1.0), PARAMS)
    assert not faults
    memory, faults = supervise(memory, HOLDING, observation(1.4), PARAMS)
    assert not faults
    memory, faults = supervise(memory, HOLDING, observation(1.9), PARAMS)
    assert [fault.code for fault in faults] == [FaultCode.LOOP_LATE]


@pytest.mark.parametrize("phase", [phase for phase in Phase if phase not in AT_STAKE and phase is not Phase.FAULT])
def test_nothing_at_stake_nothing_wrong(phase: Phase) -> None:
    _, fault = first_fault(
        grasp_state(phase=phase), lambda t: observation(t, gripper=None, arm=None, fused=None, left=LOST, right=LOST)
    )
    assert fault is None


def test_a_passed_fault_is_no_longer_reported() -> None:
    """So that it can be cleared."""
    state = grasp_state(phase=Phase.FAULT)
    memory, faults = supervise(KNOWN, state, observation(0.0, gripper=None), PARAMS)
    memory, faults = supervise(memory, state, observation(0.45, gripper=None), PARAMS)
    assert faults
    memory, faults = supervise(memory, state, observation(0.46), PARAMS)
    assert not faults
    memory, faults = supervise(memory, state, observation(0.47, gripper=None), PARAMS)
    assert not faults


def test_the_gravest_comes_first() -> None:
    view = observation(0.0, arm=arm(emergency=True), gripper=gripper(fault="9"), left=LOST)
    _, faults = supervise(Supervision(), HOLDING, view, PARAMS)
    assert [fault.code for fault in faults] == [FaultCode.ARM_EMERGENCY, FaultCode.GRIPPER_FAULT]


def test_a_finger_that_only_ages_is_lost_too() -> None:
    old = FingerHealth(Condition.FRESH, 0.35)
    _, (fault,) = supervise(Supervision(), HOLDING, observation(0.0, left=old, right=old), PARAMS)
    assert fault.code is FaultCode.FRAMES_LOST
    assert "fresh" in fault.observed


def test_an_arm_not_received_since_the_start_gets_time() -> None:
    """So that what a restarted daemon finds held is guarded before the arm's control program runs."""
    found = grasp_state(phase=Phase.HOLDING, closed=True)
    memory, faults = supervise(Supervision(), found, observation(0.0, arm=None), PARAMS)
    for number in range(1, 50):
        memory, faults = supervise(memory, found, observation(0.1 * number, arm=None), PARAMS)
        assert not faults
    memory, (fault,) = supervise(memory, found, observation(5.01, arm=None), PARAMS)
    assert fault.code is FaultCode.ARM_SILENT
    memory, faults = supervise(memory, found, observation(5.1), PARAMS)
    memory, faults = supervise(memory, found, observation(5.2, arm=None), PARAMS)
    memory, (fault,) = supervise(memory, found, observation(5.61, arm=None), PARAMS)
    assert fault.code is FaultCode.ARM_SILENT


def test_an_arm_received_while_nothing_was_held_is_known() -> None:
    memory, _ = supervise(Supervision(), grasp_state(phase=Phase.IDLE), observation(0.0), PARAMS)
    assert memory.arm_known
    memory, _ = supervise(memory, grasp_state(phase=Phase.IDLE), observation(0.1, arm=None), PARAMS)
    assert memory.arm_known
    memory, _ = supervise(memory, HOLDING, observation(0.2, arm=None), PARAMS)
    _, (fault,) = supervise(memory, HOLDING, observation(0.61, arm=None), PARAMS)
    assert fault.code is FaultCode.ARM_SILENT


@pytest.mark.parametrize(
    ("ground_mm", "expected"),
    [(-110.0, "the arm stopped itself 110 mm above the start of the lift"), (None, "the arm stopped itself")],
)
def test_a_stop_of_the_arm_names_the_height_only_above_a_known_start(ground_mm: float | None, expected: str) -> None:
    """The arm's own height counts from its last connection."""
    state = grasp_state(phase=Phase.HOLDING, referenced=True, target_n=40.0, ground_mm=ground_mm)
    _, fault = first_fault(state, lambda t: observation(t, arm=arm(at_s=t, protective=True)))
    assert fault is not None
    assert fault.observed == expected
