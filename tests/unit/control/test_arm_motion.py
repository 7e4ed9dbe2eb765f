"""Commands to the arm, with the whole state, at and next to every limit."""

from __future__ import annotations

import pytest
from controller_steps import FAULT
from observations import arm, guard_params, observation
from records import changed, grasp_state

from slipguard.control.arm_motion import (
    FRESH_S,
    REACHED_MM,
    REPEAT_S,
    START_S,
    continue_down,
    has_ended,
    put_down,
    stop,
)
from slipguard.control.messages import LiftArm, StepOutput, StopArm
from slipguard.control.params import GuardParams
from slipguard.control.reports import Fault, FaultCode, Text
from slipguard.control.state import GraspState, Phase

LOWER = guard_params(on_force_limit="lower", lower_speed_mm_s=12.0)
SPENT = Fault(FaultCode.FORCE_LIMIT_REACHED, "slips on", "support it")
FAULTED = grasp_state(Phase.FAULT, ground_mm=10.0, fault=SPENT)
DOWN = changed(FAULTED, putting_down=True, goal_mm=10.0)
SAID = StepOutput(messages=(Text.GRIPPED.message(),))
LATE_S = 64.0
"""A power of two: sums and differences with the limits stay exact enough to try both sides."""


@pytest.mark.parametrize(
    ("moving", "known", "since_s", "at_once", "stops"),
    [
        (False, True, 9.0, False, False),
        (False, True, 0.0, True, True),
        (True, True, REPEAT_S, False, True),
        (True, True, REPEAT_S - 0.01, False, False),
        (True, True, 0.0, True, True),
        (True, False, REPEAT_S, False, True),
        (True, False, REPEAT_S - 0.01, False, False),
    ],
)
def test_stop(moving: bool, known: bool, since_s: float, at_once: bool, stops: bool) -> None:
    state = changed(FAULTED, arm_commanded_s=0.0)
    view = observation(since_s, arm=arm(50.0, moving=moving) if known else None)
    after, command = stop(state, view, SAID, at_once=at_once)
    assert command == (changed(SAID, arm=StopArm()) if stops else SAID)
    assert after == (changed(state, arm_commanded_s=since_s) if stops else state)


@pytest.mark.parametrize(
    ("moving", "measured_s", "now_s", "sent_s", "is_ended"),
    [
        (False, START_S, START_S, 0.0, True),
        (True, START_S, START_S, 0.0, False),
        (False, START_S - 0.01, START_S - 0.01, 0.0, False),
        (False, 0.0, START_S, 0.0, False),
        (False, FRESH_S, 2.0 * FRESH_S, FRESH_S - START_S, True),
        (False, 0.0, FRESH_S, -1.0, True),
        (False, 0.0, FRESH_S + 0.01, -1.0, False),
        (False, LATE_S, LATE_S, LATE_S - 0.125, False),
        (False, LATE_S, LATE_S, LATE_S, False),
    ],
)
def test_ended(moving: bool, measured_s: float, now_s: float, sent_s: float, is_ended: bool) -> None:
    here = arm(50.0, moving=moving, at_s=measured_s)
    assert has_ended(changed(FAULTED, arm_commanded_s=sent_s), here, now_s) is is_ended


@pytest.mark.parametrize("code", FaultCode)
def test_what_is_put_down(code: FaultCode) -> None:
    state = changed(FAULTED, fault=Fault(code, "seen", "do"))
    after, command = put_down((state, SAID), observation(5.0, arm=arm(60.0, at_s=5.0)), LOWER)
    if code not in (FaultCode.FORCE_LIMIT_REACHED, FaultCode.ROTATED_TOO_FAR):
        assert (after, command) == (state, SAID)
        return
    assert after == changed(state, putting_down=True, goal_mm=10.0, arm_commanded_s=5.0)
    assert command == changed(SAID, arm=LiftArm(-50.0, 12.0)).with_messages(Text.PUTTING_DOWN.message(height_mm=50.0))


def test_it_goes_no_faster_than_a_lowering() -> None:
    slow = guard_params(on_force_limit="lower", lower_speed_mm_s=30.0)
    _, command = put_down((FAULTED, SAID), observation(5.0, arm=arm(60.0, at_s=5.0)), slow)
    assert command.arm == LiftArm(-50.0, 30.0)


@pytest.mark.parametrize(
    ("state", "height_mm", "params", "says"),
    [
        (changed(FAULTED, fault=None), 60.0, LOWER, None),
        (changed(FAULTED, person_near=True), 60.0, LOWER, None),
        (FAULTED, 60.0, GuardParams(), None),
        (FAULTED, 60.0, LOWER.model_copy(update={"mode": "guard"}), None),
        (FAULTED, 10.0, LOWER, None),
        (FAULTED, 10.0 + REACHED_MM - 0.125, LOWER, None),
        (FAULTED, None, LOWER, Text.NO_WAY_DOWN),
        (changed(FAULTED, ground_mm=None), 60.0, LOWER, Text.NO_WAY_DOWN),
    ],
)
def test_where_the_arm_stands(
    state: GraspState, height_mm: float | None, params: GuardParams, says: Text | None
) -> None:
    view = observation(5.0, arm=None if height_mm is None else arm(height_mm))
    after, command = put_down((state, SAID), view, params)
    assert after == state
    assert command == SAID.with_messages(says and says.message())


def test_at_the_very_limit_there_is_a_way() -> None:
    after, _ = put_down((FAULTED, SAID), observation(5.0, arm=arm(10.0 + REACHED_MM)), LOWER)
    assert after.arm.putting_down


def moment(now_s: float, height_mm: float, *, moving: bool = False) -> object:
    return observation(now_s, arm=arm(height_mm, moving=moving, at_s=now_s))


def test_on_the_way_it_waits_until_the_arm_rests() -> None:
    state = changed(DOWN, arm_commanded_s=4.0)
    for view in (moment(5.0, 40.0, moving=True), moment(4.125, 40.0)):
        assert continue_down(state, view, SAID, LOWER) == (state, SAID)  # type: ignore[arg-type]


def test_an_arm_at_rest_above_the_table_gets_the_rest_of_the_way() -> None:
    state = changed(DOWN, arm_commanded_s=4.0)
    after, command = continue_down(state, moment(5.0, 40.0), SAID, LOWER)  # type: ignore[arg-type]
    assert after == changed(state, arm_commanded_s=5.0)
    assert command == changed(SAID, arm=LiftArm(-30.0, 12.0))
    after, command = continue_down(state, moment(5.0, 10.0 + REACHED_MM), SAID, LOWER)  # type: ignore[arg-type]
    assert command.arm == LiftArm(-REACHED_MM, 12.0)


@pytest.mark.parametrize("height_mm", [10.0, 9.0, 10.0 + REACHED_MM - 0.125])
def test_where_the_lift_began_it_ends(height_mm: float) -> None:
    state = changed(DOWN, arm_commanded_s=4.0)
    after, command = continue_down(state, moment(5.0, height_mm), SAID, LOWER)  # type: ignore[arg-type]
    assert after == changed(state, putting_down=False)
    assert after.arm.putting_down is False
    assert command == SAID.with_messages(Text.PUT_DOWN.message())


@pytest.mark.parametrize("wrong", ["arm", "goal", "person", "fault", "also"])
@pytest.mark.parametrize("sent_s", [4.0, 4.96875])
def test_anything_else_stops_it_at_once_and_for_good(wrong: str, sent_s: float) -> None:
    state, view = changed(DOWN, arm_commanded_s=sent_s), observation(5.0, arm=arm(40.0, moving=True, at_s=5.0))
    if wrong == "arm":
        view = changed(view, arm=None)
    elif wrong == "goal":
        state = changed(state, goal_mm=None)
    elif wrong == "person":
        state = changed(state, person_near=True)
    elif wrong == "fault":
        view = changed(view, fault=FAULT)
    else:
        view = changed(view, fault=SPENT, other_faults=(FAULT,))
    after, command = continue_down(state, view, SAID, LOWER)
    assert after == changed(state, putting_down=False, arm_commanded_s=5.0)
    assert after.arm.putting_down is False
    assert command == changed(SAID, arm=StopArm()).with_messages(Text.PUT_DOWN_STOPPED.message())


def test_more_of_the_same_slip_stops_nothing() -> None:
    state, view = changed(DOWN, arm_commanded_s=4.0), moment(5.0, 40.0, moving=True)
    no_help = Fault(FaultCode.TIGHTENING_INEFFECTIVE, "seen", "do")
    view = changed(view, fault=no_help, other_faults=(SPENT,))  # type: ignore[type-var]
    assert continue_down(state, view, SAID, LOWER) == (state, SAID)
