"""The law written out: every phase, every wish and everything that can go wrong, what was commanded, said, remembered.

`python tests/unit/control/golden_cases.py` rewrites `golden_cases.txt`; review the changes before
you commit them. Slip detection and its answer are not in it: they have tests of their own.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from controller_steps import NOW_S, seen_in, state_in
from observations import ask, fused, guard_params

from slipguard.control.fault import Fault, FaultCode
from slipguard.control.messages import (
    ArmLift,
    Command,
    Condition,
    ControlRequest,
    FingerHealth,
    Observation,
    RequestKind,
)
from slipguard.control.params import GuardParams
from slipguard.control.state import AT_STAKE, GraspState, Phase, RememberedGrip
from slipguard.control.step import ControlState, control_step
from slipguard.control.supervisor import Supervision

LEDGER = Path(__file__).with_suffix(".txt")
LEFT_OUT = ("detector", "delay", "slip", "fault")
PARAMS = {
    "lift": guard_params(lift_height_mm=80.0),
    "lower": guard_params(on_force_limit="lower", on_no_estimate="refuse", stop_on_slip=False),
    "guard": guard_params(mode="guard"),
}
GONE = FingerHealth(Condition.LOST, 2.0, "unplugged")
OLD = FingerHealth(Condition.STALE, 0.31, "its frames are old")
View = Callable[[Observation], Observation]


def jaws(**changes: Any) -> View:
    return lambda view: replace(view, gripper=view.gripper and replace(view.gripper, **changes))


def here(**changes: Any) -> View:
    return lambda view: replace(view, arm=view.arm and replace(view.arm, **changes))


def sight(**changes: Any) -> View:
    return lambda view: replace(view, fused=fused(at_s=view.now_s, **changes))


def fixed(**changes: Any) -> View:
    return lambda view: replace(view, **changes)


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
    "conflict": sight(conflict="both pictures turn the same way (left +2.0°, right +2.1°)"),
    "no contact": sight(rotation_deg=None, contact=False, shift_mm=None, declined="no contact"),
    "no contact, one finger": lambda view: replace(
        view, fused=replace(fused(None, at_s=view.now_s, contact=False, shift_mm=None), left_contact=None)
    ),
    "turned far": sight(rotation_deg=60.0),
    "told": sight(),
}
WISHES: dict[str, ControlRequest] = {
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
    "clear": ask(RequestKind.CLEAR),
}
BESIDE_A_WISH = (
    "nothing", "no gripper", "gripper fault", "not active", "empty", "closing", "held", "no arm", "arm rests",
    "protective stop", "emergency stop", "round", "tightening",
)  # fmt: skip
STARTS: dict[str, dict[str, Any]] = {
    "new": {"adopted": False, "remembered": RememberedGrip(91.0, 30.0)},
    "unguarded": {"guarding": False},
    "paused": {"paused": True},
    "no ground": {"ground_mm": None},
    "blind": {"blind": "round contact", "referenced": False},
    "person": {"person_near": True},
    "nobody commanded": {"commanded_s": float("-inf")},
    "just commanded": {"commanded_s": NOW_S + 0.03},
    "long ago": {"since_s": NOW_S - 6.0},
    "down": {"putting_down": True, "goal_mm": 0.0, "fault": Fault(FaultCode.BUDGET_SPENT, "slips", "support it")},
}


def stories() -> Iterator[tuple[str, GuardParams, Phase, dict[str, Any], View, ControlRequest, float]]:
    """Name, parameters, phase, how its memory differs, what happens, what is asked first, time between ticks."""
    for phase in Phase:
        for event, view in EVENTS.items():
            yield f"{phase}: {event}", PARAMS["lift"], phase, {}, view, ControlRequest(), 0.12
            yield f"{phase}: {event}, for long", PARAMS["lift"], phase, {}, view, ControlRequest(), 0.45
        for wish, request in WISHES.items():
            for event in BESIDE_A_WISH:
                yield f"{phase}: {wish}, {event}", PARAMS["lift"], phase, {}, EVENTS[event], request, 0.12
            for name in ("lower", "guard"):
                yield f"{phase}: {wish} ({name})", PARAMS[name], phase, {}, EVENTS["nothing"], request, 0.12
            for start, changes in STARTS.items():
                yield f"{phase}: {wish}, {start}", PARAMS["lift"], phase, changes, EVENTS["nothing"], request, 0.12
        for start, changes in STARTS.items():
            for event, view in EVENTS.items():
                yield f"{phase}: {event}, {start}", PARAMS["lower"], phase, changes, view, ControlRequest(), 0.3


def moment(phase: Phase, now_s: float) -> Observation:
    view = seen_in(phase)
    return replace(
        view,
        now_s=now_s,
        gripper=view.gripper and replace(view.gripper, measured_at_s=now_s),
        arm=view.arm and replace(view.arm, measured_at_s=now_s),
        fused=view.fused and replace(view.fused, captured_at_s=now_s, measured_at_s=now_s),
    )


def ledger() -> list[str]:
    """Stories with the same outcome in one line: the outcome, then their names."""
    lines: dict[str, list[str]] = {}
    for name, params, phase, changes, view, request, step_s in stories():
        grasp = replace(state_in(phase, gripped=phase in AT_STAKE - {Phase.CLOSING} or phase is Phase.FAULT), **changes)
        guard = ControlState(grasp, Supervision(tick_s=NOW_S - 0.02, arm_known=True))
        told = []
        for number in range(4):
            observation = view(moment(phase, NOW_S + step_s * number))
            observation = replace(observation, request=request if number == 1 else ControlRequest())
            before = guard.grasp
            guard, command = control_step(guard, observation, params)
            told.append(f"{_changes(before, guard.grasp)} {_command(command)}".strip())
        lines.setdefault(" | ".join(told), []).append(name)
    return [f"{'; '.join(names)} => {told}" for told, names in lines.items()]


def _changes(before: GraspState, after: GraspState) -> str:
    """The fields that changed, and what to."""
    names = [one.name for one in fields(GraspState) if one.name not in LEFT_OUT]
    changed = [name for name in names if getattr(before, name) != getattr(after, name)]
    kept = [name for name in ("fault",) if getattr(before, name) != getattr(after, name)]
    return " ".join(
        [f"{name}={_plain(getattr(after, name))}" for name in changed]
        + [f"{name}={getattr(after, name) and getattr(after, name).code.value}" for name in kept]
    )


def _command(command: Command) -> str:
    told = [(one.name, getattr(command, one.name)) for one in fields(Command) if one.name != "fault"]
    plain = [f"{name}:{_plain(value)}" for name, value in told if value not in (None, False)]
    return " ".join(plain + (["FAULT"] if command.fault is not None else []))


def _plain(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:g}"
    if isinstance(value, ArmLift):
        return f"{value.height_mm:g}@{value.speed_mm_s:g}"
    if isinstance(value, frozenset):
        return ",".join(sorted(value))
    return str(value)


if __name__ == "__main__":
    LEDGER.write_text("\n".join(ledger()) + "\n", encoding="utf-8")
    print(f"{LEDGER}: {len(ledger())} stories; look at what has changed")
