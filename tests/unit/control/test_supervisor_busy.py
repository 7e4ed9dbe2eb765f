"""A machine that is too busy to read its devices is the fault, not the devices."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from observations import arm, gripper, observation
from test_supervisor import HOLDING, KNOWN, LIFTING, LOST, STALE, TICK_S, first_fault

from slipguard.control.messages import Condition, FingerHealth, Observation
from slipguard.control.params import GuardParams
from slipguard.control.reports import Fault, FaultCode
from slipguard.control.supervisor import Supervision, supervise

PARAMS = GuardParams()
STUCK = FingerHealth(Condition.STUCK, 0.4, "the processing of a frame has not returned for 0.40 s")
LATE = FingerHealth(Condition.LATE, 0.4, "its frames are processed 0.40 s late")
SILENT: list[tuple[str, Callable[[float, float], Observation], FaultCode]] = [
    ("gripper", lambda t, busy_s: observation(t, gripper=gripper(at_s=0.0), busy_s=busy_s), FaultCode.GRIPPER_SILENT),
    ("arm", lambda t, busy_s: observation(t, arm=arm(at_s=0.0), busy_s=busy_s), FaultCode.ARM_SILENT),
    ("frames", lambda t, busy_s: observation(t, left=STALE, right=LOST, busy_s=busy_s), FaultCode.FRAMES_LOST),
]


@pytest.mark.parametrize(("view", "code"), [case[1:] for case in SILENT], ids=[case[0] for case in SILENT])
def test_the_busy_machine_is_named_if_the_loop_was_late(
    view: Callable[[float, float], Observation], code: FaultCode
) -> None:
    at_s, fault = first_fault(HOLDING, lambda t: view(t, 0.3))
    assert fault is not None
    assert fault.code is FaultCode.MACHINE_BUSY
    assert fault.observed.startswith(f"{code}: no ")
    assert fault.observed.endswith("the control loop was late for 0.30 s of the last second")
    assert fault.what_to_do == "find what keeps the machine busy, then clear"
    unhurried_s, fault = first_fault(HOLDING, lambda t: view(t, 0.1))
    assert fault is not None
    assert fault.code is code
    assert at_s == unhurried_s, "the fault is not delayed"


@pytest.mark.parametrize(
    ("view", "code"),
    [
        (lambda t: observation(t, gripper=None, busy_s=0.9), FaultCode.GRIPPER_SILENT),
        (lambda t: observation(t, arm=None, busy_s=0.9), FaultCode.ARM_SILENT),
        (lambda t: observation(t, left=LOST, right=LOST, busy_s=0.9), FaultCode.FRAMES_LOST),
    ],
)
def test_a_device_that_is_gone_is_named_however_busy_the_machine_is(
    view: Callable[[float], Observation], code: FaultCode
) -> None:
    _, fault = first_fault(HOLDING, view)
    assert fault is not None
    assert fault.code is code


def test_workers_that_are_late_are_named() -> None:
    at_s, fault = first_fault(HOLDING, lambda t: observation(t, left=LATE, right=LATE))
    assert fault == Fault(
        FaultCode.MACHINE_BUSY,
        "frames arrive, but are processed 0.4 s late (left: its frames are processed 0.40 s late and right: its frames "
        "are processed 0.40 s late)",
        "find what keeps the machine busy, then clear",
    )
    assert at_s == 0.0


def test_several_silent_devices_of_a_busy_machine_are_one_fault() -> None:
    view = observation(0.0, left=STALE, right=STALE, gripper=gripper(at_s=-1.0), arm=arm(at_s=-1.0), busy_s=0.8)
    memory = KNOWN
    for number in range(50):
        now_s = number * TICK_S
        memory, faults = supervise(memory, HOLDING, at(view, now_s), PARAMS)
    assert [fault.code for fault in faults] == [FaultCode.MACHINE_BUSY]


def at(view: Observation, now_s: float) -> Observation:
    return observation(now_s, **{name: getattr(view, name) for name in ("left", "right", "gripper", "arm", "busy_s")})


def test_after_a_suspension_the_loop_is_the_fault_and_the_devices_get_their_time() -> None:
    memory = Supervision(0.0, 0.0, arm_known=True, gripper_known=True, frames_known=True, gained_mm=10.0, gained_s=0.0)
    old = {"left": FingerHealth(Condition.STALE, 6.0), "right": FingerHealth(Condition.STALE, 6.0)}

    def after(now_s: float) -> Observation:
        return observation(now_s, gripper=gripper(at_s=0.0), arm=arm(at_s=0.0, height_mm=10.0), **old)

    memory, faults = supervise(memory, LIFTING, after(6.0), PARAMS)
    assert [fault.code for fault in faults] == [FaultCode.LOOP_LATE]
    assert "no control step for 6.00 s" in faults[0].observed
    memory, faults = supervise(memory, LIFTING, after(6.2), PARAMS)
    assert faults == ()
    memory, faults = supervise(memory, LIFTING, after(6.5), PARAMS)
    assert [fault.code for fault in faults] == [
        FaultCode.GRIPPER_SILENT,
        FaultCode.FRAMES_LOST,
        FaultCode.ARM_SILENT,
    ]


@pytest.mark.parametrize(("other", "code"), [(STUCK, FaultCode.FRAMES_LOST), (LATE, FaultCode.MACHINE_BUSY)])
def test_processing_that_hangs_is_named_unless_the_machine_is_busy(other: FingerHealth, code: FaultCode) -> None:
    _, fault = first_fault(HOLDING, lambda t: observation(t, left=STUCK, right=other))
    assert fault is not None
    assert fault.code is code
    assert "left: the processing of a frame has not returned for 0.40 s" in fault.observed
    assert ("restart slipguard" in fault.what_to_do) is (code is FaultCode.FRAMES_LOST)
