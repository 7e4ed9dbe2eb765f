"""Lost, blind or there: what follows from what the gripper says and what each finger can say."""

from __future__ import annotations

from itertools import product

import pytest
from controller_steps import NOW_S, PARAMS, Play, seen_in, state_in
from observations import fused, gripper
from records import changed

from slipguard.control.finger_fusion import FusedEstimate
from slipguard.control.messages import RequestKind
from slipguard.control.object_presence import TABLE, Jaws, Sight, watch_object
from slipguard.control.reports import Fault, FaultCode
from slipguard.control.state import AT_STAKE, Phase
from slipguard.devices import GripperState

CONTACTS = {Sight.CONTACT: True, Sight.ENDED: False, Sight.NOT_YET: False, Sight.NONE: None}
GRIPPERS: dict[Jaws, list[GripperState | None]] = {
    Jaws.HOLD: [gripper(40.0), None],
    Jaws.MOVE: [gripper(40.0, holding=False, moving=True)],
    Jaws.EMPTY: [gripper(40.0, holding=False), gripper(40.0, holding=False, nothing=True)],
}
STEP_S = 0.02
GRIPPED = sorted(AT_STAKE - {Phase.CLOSING})


def seen(left: bool | None, right: bool | None) -> FusedEstimate | None:
    if left is right is None:
        return None
    return changed(fused(None, shift_mm=None, declined="x"), left_contact=left, right_contact=right)


def first_fault(jaws: GripperState | None, left: Sight, right: Sight, phase: Phase) -> tuple[Fault, float] | None:
    """Return the first fault and when it comes, within two seconds."""
    seen_by = frozenset(name for name, sight in (("left", left), ("right", right)) if sight is not Sight.NOT_YET)
    state = state_in(phase, seen_by=seen_by)
    view = changed(seen_in(phase), gripper=jaws, fused=seen(CONTACTS[left], CONTACTS[right]))
    for number in range(100):
        state, fault = watch_object(state, changed(view, now_s=NOW_S + STEP_S * number), PARAMS)
        if fault is not None:
            return fault, STEP_S * number
    return None


def expected(jaws: Jaws, sights: set[Sight]) -> tuple[FaultCode, float] | None:
    """The rules in words."""
    if jaws is Jaws.EMPTY:
        return FaultCode.OBJECT_LOST, 0.1
    if Sight.CONTACT in sights:
        return None
    if Sight.ENDED in sights:
        in_doubt = jaws is Jaws.HOLD and sights != {Sight.ENDED}
        return FaultCode.OBJECT_LOST, 0.3 if in_doubt else 0.1
    if Sight.NOT_YET in sights:
        return FaultCode.FINGERS_BLIND, 1.0
    return None  # the supervisor's fault, by its cause


@pytest.mark.parametrize("jaws", Jaws)
@pytest.mark.parametrize(("left", "right"), list(product(Sight, Sight)))
def test_the_table(jaws: Jaws, left: Sight, right: Sight) -> None:
    for state, phase in product(GRIPPERS[jaws], GRIPPED):
        found = first_fault(state, left, right, phase)
        if (rule := expected(jaws, {left, right})) is None:
            assert found is None
        else:
            assert found is not None
            assert (found[0].code, found[1]) == (rule[0], pytest.approx(rule[1], abs=STEP_S + 1e-6))


def test_the_table_has_every_pair() -> None:
    assert set(TABLE) == {frozenset(pair) for pair in product(Sight, Sight)}
    assert all(set(row) == set(Jaws) for row in TABLE.values())


def test_an_object_that_the_gripper_may_hold_is_never_to_be_released() -> None:
    for jaws, left, right in product((Jaws.HOLD, Jaws.MOVE), Sight, Sight):
        for state in GRIPPERS[jaws]:
            found = first_fault(state, left, right, Phase.HOLDING)
            assert found is None or not {"release", "take"} & set(found[0].what_to_do.replace(",", "").split())


def test_a_finger_is_believed_from_the_first_contact_in_this_grip_on_until_the_next() -> None:
    play = Play().held()
    play.view = seen(False, False)
    assert play.steps(0.2)[-1].fault is not None
    play.step(RequestKind.CLEAR)
    assert play.grasp.held.seen_by == {"left", "right"}, "the same grip"
    play.step(RequestKind.RELEASE)
    play.steps(0.5)
    play.step(RequestKind.GRASP)
    assert play.grasp.held.seen_by == frozenset()


def test_no_grip_is_made_firmer_for_an_object_that_no_finger_has_seen() -> None:
    play = Play()
    play.step(RequestKind.GRASP)
    play.view = seen(False, False)
    outputs = play.steps(1.5)
    assert [output.fault.code for output in outputs if output.fault][:1] == [FaultCode.FINGERS_BLIND]
    assert {output.hold_force_n for output in outputs} == {None}


def test_a_contact_that_is_seen_late_after_the_grip_is_reported_once() -> None:
    play = Play()
    play.step(RequestKind.GRASP)
    play.view = seen(False, False)
    play.steps(0.4)
    play.view = seen(True, True)
    texts = [output.text or "" for output in play.steps(0.2)]
    assert sum("contact was seen" in text for text in texts) == 1
