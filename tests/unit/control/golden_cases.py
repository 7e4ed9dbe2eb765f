"""What the controller commands, reports and enters: every phase, every request and everything that can go wrong.

`PYTHONPATH=tests/unit python tests/unit/control/golden_cases.py` rewrites `golden/<phase>.txt`, a case in each line,
and `golden/<phase>_texts.txt`, all messages and refusals in these cases; review the diff before you commit them. Slip
detection and the response to it have tests of their own.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from controller_steps import NOW_S, seen_in, state_in
from observations import ask, fused, guard_params
from records import changed

from slipguard.control.control_step import ControlState, control_step
from slipguard.control.messages import Condition, ControlRequest, FingerHealth, Observation, RequestKind, StepOutput
from slipguard.control.params import GuardParams
from slipguard.control.reports import Fault, FaultCode
from slipguard.control.state import AT_STAKE, GraspState, Phase, RememberedGrip
from slipguard.control.supervisor import Supervision

FOLDER = Path(__file__).parent / "golden"
PARAMS = {
    "lift": guard_params(lift_height_mm=80.0),
    "lower": guard_params(on_force_limit="lower", on_no_estimate="refuse", stop_on_slip=False),
    "guard": guard_params(mode="guard"),
    "known object": guard_params(friction=0.6, mass_kg=0.4, lever_mm=60.0),
}
GONE = FingerHealth(Condition.LOST, 2.0, "unplugged")
OLD = FingerHealth(Condition.STALE, 0.31, "its frames are old")
View = Callable[[Observation], Observation]


def jaws(**changes: Any) -> View:
    return lambda view: changed(view, gripper=view.gripper and changed(view.gripper, **changes))


def here(**changes: Any) -> View:
    return lambda view: changed(view, arm=view.arm and changed(view.arm, **changes))


def sight(**changes: Any) -> View:
    return lambda view: changed(view, fused=fused(at_s=view.now_s, **changes))


def fixed(**changes: Any) -> View:
    return lambda view: changed(view, **changes)


EVENTS: dict[str, View] = {
    "nothing": lambda view: view,
    "no gripper": fixed(gripper=None),
    "gripper fault": jaws(fault="overcurrent"),
    "not active": jaws(active=False),
    "old gripper": jaws(measured_at_s=NOW_S - 0.3),
    "empty": jaws(holding=False, moving=False),
    "closing": jaws(holding=False, moving=True),
    "on nothing": jaws(holding=False, moving=False, closed_on_nothing=True, width_mm=0.0),
    "held": jaws(holding=True, moving=False),
    "held weakly": jaws(holding=True, moving=False, force_n=25.0),
    "held strongly": jaws(holding=True, moving=False, force_n=140.0),
    "tightening": jaws(holding=True, moving=True),
    "no arm": fixed(arm=None),
    "old arm": here(measured_at_s=NOW_S - 0.3),
    "arm rests": here(moving=False),
    "arm moves": here(moving=True),
    "arm at the top": here(moving=False, height_mm=99.6),
    "arm below": here(moving=False, height_mm=0.4),
    "probe height": here(moving=False, height_mm=14.8),
    "protective stop": here(protective_stop=True),
    "emergency stop": here(emergency_stop=True),
    "no fingers": fixed(fused=None, left=GONE, right=GONE),
    "old fingers": fixed(fused=None, left=OLD, right=OLD),
    "one finger": sight(fingers=("left",), note="right finger: round contact"),
    "round": sight(rotation_deg=None, declined="left finger: round contact; right finger: round contact"),
    "conflict": sight(conflict="both images rotate the same way (left +2.0°, right +2.1°)"),
    "no contact": sight(rotation_deg=None, contact=False, shift_mm=None, declined="no contact"),
    "no contact in one finger": lambda view: changed(
        view, fused=changed(fused(None, at_s=view.now_s, contact=False, shift_mm=None), left_contact=None)
    ),
    "rotated far": sight(rotation_deg=60.0),
    "estimated": sight(),
}
CONTACTS: dict[str, View] = {
    "a small contact": sight(contact_radius_mm=5.0),
    "a large contact": sight(contact_radius_mm=16.0),
    "a small round contact": sight(contact_radius_mm=5.0, rotation_deg=None, declined="round contact"),
    "no radius": sight(),
}
REQUESTS: dict[str, ControlRequest] = {
    "grasp": ask(RequestKind.GRASP),
    "grasp 60": ask(RequestKind.GRASP, force_n=60.0),
    "grasp 200": ask(RequestKind.GRASP, force_n=200.0),
    "lift": ask(RequestKind.LIFT),
    "lift 10": ask(RequestKind.LIFT, height_mm=10.0, speed_mm_s=15.0),
    "lower": ask(RequestKind.LOWER),
    "lower 20": ask(RequestKind.LOWER, height_mm=20.0, speed_mm_s=25.0),
    "guard on": ask(RequestKind.GUARD_ON),
    "guard off": ask(RequestKind.GUARD_OFF),
    "jaws": ask(RequestKind.GRIPPER),
    "jaws 80": ask(RequestKind.GRIPPER, width_mm=80.0),
    "jaws 90 N": ask(RequestKind.GRIPPER, force_n=90.0, width_mm=10.0),
    "jaws 200 N": ask(RequestKind.GRIPPER, force_n=200.0),
    "release": ask(RequestKind.RELEASE),
    "release 70": ask(RequestKind.RELEASE, width_mm=70.0),
    "stop": ask(RequestKind.STOP),
    "clear": ask(RequestKind.CLEAR),
    "activate": ask(RequestKind.ACTIVATE),
}
WITH_A_REQUEST = (
    "nothing", "no gripper", "gripper fault", "not active", "empty", "closing", "held", "no arm", "arm rests",
    "protective stop", "emergency stop", "round", "tightening",
)  # fmt: skip
STARTS: dict[str, dict[str, Any]] = {
    "new": {"adopted": False, "remembered": RememberedGrip(91.0, 30.0)},
    "unguarded": {"guarding": False},
    "paused": {"paused": True},
    "no ground": {"ground_mm": None},
    "no estimate": {"no_estimate": "round contact", "referenced": False},
    "person": {"person_near": True},
    "not commanded": {"commanded_s": float("-inf")},
    "just commanded": {"commanded_s": NOW_S + 0.03},
    "long ago": {"since_s": NOW_S - 6.0},
    "down": {
        "putting_down": True, "goal_mm": 0.0, "fault": Fault(FaultCode.FORCE_LIMIT_REACHED, "slips", "support it"),
    },
    "interrupted": {"closing_interrupted": True},
}  # fmt: skip

Story = tuple[str, GuardParams, dict[str, Any], View, ControlRequest, float]


def stories() -> Iterator[Story]:
    """Name, parameters, how the state differs, what happens, what is requested in the second step, time between."""
    for event, view in EVENTS.items():
        yield event, PARAMS["lift"], {}, view, ControlRequest(), 0.12
        yield f"{event}, slowly", PARAMS["lift"], {}, view, ControlRequest(), 0.45
    for name, request in REQUESTS.items():
        for event in WITH_A_REQUEST:
            yield f"{name}, {event}", PARAMS["lift"], {}, EVENTS[event], request, 0.12
        for mode in ("lower", "guard"):
            yield f"{name} ({mode})", PARAMS[mode], {}, EVENTS["nothing"], request, 0.12
        for start, changes in STARTS.items():
            yield f"{name}, {start}", PARAMS["lift"], changes, EVENTS["nothing"], request, 0.12
    for start, changes in STARTS.items():
        for event, view in EVENTS.items():
            yield f"{event}, {start}", PARAMS["lower"], changes, view, ControlRequest(), 0.3
    for event, view in CONTACTS.items():
        for start, changes in (
            {"known object": {}} | {one: STARTS[one] for one in ("not commanded", "person")}
        ).items():
            yield f"{event}, {start}", PARAMS["known object"], changes, view, ControlRequest(), 0.3


def moment(phase: Phase, now_s: float) -> Observation:
    view = seen_in(phase)
    return changed(
        view,
        now_s=now_s,
        gripper=view.gripper and changed(view.gripper, measured_at_s=now_s),
        arm=view.arm and changed(view.arm, measured_at_s=now_s),
        fused=view.fused and changed(view.fused, captured_at_s=now_s, measured_at_s=now_s),
    )


def cases(phase: Phase) -> tuple[list[str], list[str]]:
    """Lines and texts: a case's name, then what follows in each of four steps, "." where nothing does; all messages."""
    lines, texts = [], set()
    for name, params, changes, view, request, step_s in stories():
        closed = phase in AT_STAKE - {Phase.CLOSING} or phase is Phase.FAULT
        state = ControlState(
            changed(state_in(phase, closed=closed), **changes), Supervision(stepped_s=NOW_S - 0.02, arm_known=True)
        )
        steps = []
        for number in range(4):
            observation = view(moment(phase, NOW_S + step_s * number))
            observation = changed(observation, request=request if number == 1 else ControlRequest())
            before = state.grasp
            state, output = control_step(state, observation, params)
            steps.append(" ".join([*_entered(before, state.grasp), *_output(output)]) or ".")
            said = [*output.messages, *([output.refusal] if output.refusal is not None else [])]
            texts |= {f"{message.name}: {message.text}" for message in said}
        lines.append(f"{name}: {' | '.join(steps)}")
    return lines, sorted(texts)


def _entered(before: GraspState, after: GraspState) -> Iterator[str]:
    """The phase and the conditions that have changed, and the force target."""
    if after.phase is not before.phase:
        yield f"-> {after.phase}"
    if after.grip.target_n != before.grip.target_n:
        yield f"target {after.grip.target_n:g}"
    conditions = {
        "guarding": lambda state: state.guarding,
        "closed": lambda state: state.grip.closed,
        "referenced": lambda state: state.held.referenced,
        "adopted": lambda state: state.adoption.done,
        "paused": lambda state: state.arm.paused,
        "putting down": lambda state: state.arm.putting_down,
        "lost?": lambda state: state.held.lost_since_s is not None,
        "person near": lambda state: state.person.now,
        "release requested": lambda state: state.hands_off.release_requested,
        "stopped": lambda state: state.stop is not None,
        "closing interrupted": lambda state: state.hands_off.closing_interrupted,
    }
    for name, holds in conditions.items():
        if holds(before) is not holds(after):
            yield f"{'' if holds(after) else 'not '}{name}"


def _output(output: StepOutput) -> Iterator[str]:
    for command in (output.gripper, output.arm):
        if command is not None:
            values = [getattr(command, name) for name in command.__slots__ if name != "kind"]
            yield " ".join([command.kind.upper(), *(f"{value:g}" for value in values)])
    if output.new_reference:
        yield "REFERENCE"
    if output.refusal is not None:
        yield f"refused:{output.refusal.name}"
    yield from (f"[{message.name}]" for message in output.messages)


def write() -> None:
    """Rewrite the golden files."""
    FOLDER.mkdir(exist_ok=True)
    for phase in Phase:
        for name, lines in zip((phase, f"{phase}_texts"), cases(phase), strict=True):
            (FOLDER / f"{name}.txt").write_text("".join(f"{line}\n" for line in lines), encoding="utf-8")


if __name__ == "__main__":
    write()
