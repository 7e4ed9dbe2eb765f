"""The controller: every phase against every event."""

from __future__ import annotations

import pytest
from controller_steps import FAULT, NOW_S, PARAMS, seen_in, state_in
from observations import arm, ask, fused, gripper
from records import changed, halted, moved_mm, released_mm

from slipguard.control.control_step import step
from slipguard.control.messages import LiftArm, RequestKind, StepOutput, StopArm
from slipguard.control.state import AT_STAKE, GraspState, Phase


def describe(before: Phase, state: GraspState, command: StepOutput) -> str:
    """An outcome in a few letters, for the table."""
    words = [] if state.phase is before else [state.phase.value]
    words += ["hold"] if command.hold_force_n is not None else []
    words += ["halt"] if halted(command) else []
    words += ["move"] if moved_mm(command) is not None else []
    words += ["open"] if released_mm(command) is not None else []
    words += ["stop"] if command.arm == StopArm() else []
    words += ["go"] if isinstance(command.arm, LiftArm) else []
    words += ["reference"] if command.new_reference else []
    words += ["refused"] if command.refusal is not None else []
    return " ".join(words) or "-"


SLIP = fused(4.0, 30.0, at_s=NOW_S)
SLIDE = fused(0.0, 0.0, at_s=NOW_S, shift_mm=0.9)
BACK = fused(4.0, -30.0, at_s=NOW_S)
EVENTS: dict[str, dict[str, object]] = {
    "nothing": {},
    "grasp": {"request": ask(RequestKind.GRASP)},
    "lift": {"request": ask(RequestKind.LIFT)},
    "lower": {"request": ask(RequestKind.LOWER)},
    "guard on": {"request": ask(RequestKind.GUARD_ON)},
    "guard off": {"request": ask(RequestKind.GUARD_OFF)},
    "jaws open": {"request": ask(RequestKind.GRIPPER, width_mm=80.0)},
    "jaws tighter": {"request": ask(RequestKind.GRIPPER, force_n=60.0)},
    "release": {"request": ask(RequestKind.RELEASE)},
    "stop": {"request": ask(RequestKind.STOP)},
    "clear": {"request": ask(RequestKind.CLEAR)},
    "activate": {"request": ask(RequestKind.ACTIVATE)},
    "rotation": {"fused": SLIP},
    "slip down": {"fused": SLIDE},
    "fault": {"fault": FAULT},
    "no devices": {"gripper": None, "arm": None, "fused": None},
    "on nothing": {"gripper": gripper(40.0, holding=False, nothing=True, width_mm=0.0, at_s=NOW_S)},
    "stop, rotating": {"fused": SLIP, "arm": arm(50.0, protective=True, at_s=NOW_S)},
}
TABLES = (
    """
               | idle          | closing       | reference     | lifting
nothing        | -             | -             | -             | -
grasp          | closing hold  | refused       | refused       | refused
lift           | refused       | refused       | refused       | refused
lower          | refused       | refused       | refused       | refused
guard on       | refused       | -             | -             | -
guard off      | -             | -             | -             | -
jaws open      | move          | refused       | refused       | refused
jaws tighter   | refused       | refused       | hold          | hold
release        | released open | released open | released open | released stop
stop           | halt stop     | idle halt stop | stop          | holding stop
clear          | refused       | refused       | refused       | refused
activate       | refused       | refused       | refused       | refused
rotation       | -             | -             | holding       | hold stop
slip down      | -             | -             | holding       | hold stop
fault          | -             | fault stop    | fault stop    | fault stop
no devices     | -             | -             | -             | -
on nothing     | -             | -             | -             | -
stop, rotating | -             | halt          | holding       | stop
""",
    """
               | holding       | lowering      | released | fault
nothing        | -             | -             | -        | -
grasp          | refused       | refused       | refused  | refused
lift           | lifting go    | refused       | refused  | refused
lower          | lowering go   | refused       | refused  | refused
guard on       | -             | -             | -        | -
guard off      | -             | -             | -        | refused
jaws open      | refused       | refused       | refused  | refused
jaws tighter   | hold          | hold          | refused  | refused
release        | released open | released stop | open     | released open
stop           | stop          | holding stop  | stop     | stop
clear          | refused       | refused       | refused  | reference reference
activate       | refused       | refused       | refused  | refused
rotation       | hold stop     | hold stop     | -        | hold
slip down      | hold stop     | hold stop     | -        | hold
fault          | fault stop    | fault stop    | -        | -
no devices     | -             | -             | -        | stop
on nothing     | -             | -             | open     | -
stop, rotating | stop          | stop          | -        | -
""",
)


def cases(table: str) -> list[tuple[Phase, str, str]]:
    """Return (phase, event, outcome) of every cell."""
    header, *rows = ([cell.strip() for cell in row.split("|")] for row in table.strip("\n").splitlines())
    return [(Phase(phase), row[0], outcome) for row in rows for phase, outcome in zip(header[1:], row[1:], strict=True)]


CASES = [case for table in TABLES for case in cases(table)]


def test_the_table_names_every_phase_and_event() -> None:
    assert {(phase, name) for phase, name, _ in CASES} == {(phase, name) for phase in Phase for name in EVENTS}
    asked = {getattr(change.get("request"), "kind", RequestKind.NONE) for change in EVENTS.values()}
    assert asked == set(RequestKind)


@pytest.mark.parametrize(("phase", "event", "outcome"), CASES, ids=lambda value: str(value).replace(" ", "_"))
def test_phase_against_event(phase: Phase, event: str, outcome: str) -> None:
    state, command = step(state_in(phase), seen_in(phase, **EVENTS[event]), PARAMS)
    assert describe(phase, state, command) == outcome
    if command.refusal is not None:
        assert "\n" not in str(command.refusal)
        assert len(command.refusal.text) > 10


@pytest.mark.parametrize("event", EVENTS)
@pytest.mark.parametrize("phase", sorted(AT_STAKE))
def test_any_fault_stops_the_arm_and_keeps_the_grip_in_any_case(phase: Phase, event: str) -> None:
    if event == "release":
        return
    view = changed(seen_in(phase, **EVENTS[event]), fault=FAULT)
    state, command = step(state_in(phase), view, PARAMS)
    assert state.phase is Phase.FAULT
    assert state.grip.target_n == 40.0
    assert command.arm == StopArm()
    assert released_mm(command) is command.hold_force_n is moved_mm(command) is None
    assert command.fault == FAULT
    assert str(FAULT) in (command.text or "")
