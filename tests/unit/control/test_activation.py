"""An activation opens and closes the jaws fully: it is granted only while nothing may be held."""

from __future__ import annotations

import pytest
from controller_steps import NOW_S, PARAMS, seen_in, state_in
from observations import arm, ask, gripper
from records import changed

from slipguard.control.control_step import step
from slipguard.control.messages import ActivateGripper, RequestKind, StepOutput
from slipguard.control.state import Phase
from slipguard.devices import GripperState

OFF = gripper(0.0, holding=False, active=False, width_mm=85.0, at_s=NOW_S)


def requested(phase: Phase = Phase.IDLE, **changes: object) -> StepOutput:
    view = seen_in(phase, **{"gripper": OFF, "request": ask(RequestKind.ACTIVATE), **changes})
    return step(state_in(phase), view, PARAMS)[1]


def test_an_empty_gripper_is_activated_on_request_only() -> None:
    assert requested().gripper == ActivateGripper()
    assert requested(request=ask(RequestKind.NONE)).gripper is None
    assert requested(gripper=changed(OFF, active=True, fault="overcurrent")).gripper == ActivateGripper()


@pytest.mark.parametrize("phase", [phase for phase in Phase if phase is not Phase.IDLE])
def test_refused_while_an_object_may_be_held(phase: Phase) -> None:
    output = requested(phase, gripper=changed(OFF, moving=True))
    assert output.gripper != ActivateGripper()
    assert "would close on it and drop it" in str(output.refusal)
    assert "slipguard ctl release" in str(output.refusal)


@pytest.mark.parametrize(
    ("jaws", "why"),
    [
        (None, "not connected"),
        (changed(OFF, active=True), "already activated"),
        (changed(OFF, active=True, fault="overcurrent", holding=True), "reports a grip"),
    ],
)
def test_refused_by_what_the_gripper_reports(jaws: GripperState | None, why: str) -> None:
    output = requested(gripper=jaws)
    assert output.gripper is None
    assert why in str(output.refusal)


def test_refused_after_an_interrupted_closing_and_while_a_person_may_be_near() -> None:
    view = seen_in(Phase.IDLE, gripper=OFF, request=ask(RequestKind.ACTIVATE))
    interrupted = state_in(Phase.IDLE, closing_interrupted=True)
    assert "reports a grip" in str(step(interrupted, view, PARAMS)[1].refusal)
    near = requested(arm=arm(50.0, protective=True, at_s=NOW_S))
    assert near.gripper is None
    assert "protective" in str(near.refusal)


def test_the_refusal_of_a_grasp_names_the_command() -> None:
    output = requested(request=ask(RequestKind.GRASP))
    assert "slipguard ctl activate" in str(output.refusal)
