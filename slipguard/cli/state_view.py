"""A daemon's state as a table for the terminal: the grasp, each device, and what to do about a fault."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from typing import Any

from rich.console import Group, RenderableType
from rich.markup import escape
from rich.table import Table

from slipguard.control.messages import without_figures

HEALTH_COLORS = {"ready": "green", "error": "yellow", "disconnected": "red"}
EVENTS_MAX = 6


def state_table(state: Mapping[str, Any]) -> RenderableType:
    """Return the response of `GET /state` as a table of at most 80 columns, unless a reason is longer."""
    grasp = _two_columns()
    for name, text in _grasp_rows(state):
        grasp.add_row(name, text)
    devices = _two_columns()
    devices.add_column()
    for name, health in state.get("devices", {}).items():
        health_state = str(health.get("state"))
        color = HEALTH_COLORS.get(health_state, "white")
        devices.add_row(name, f"[{color}]{escape(health_state)}[/]", escape(_device_text(state, name, health)))
    events = _two_columns()
    for number, line in enumerate(_event_lines(state)):
        events.add_row("last events" if number == 0 else "", escape(line))
    return Group(grasp, "", devices, "", events)


def _two_columns() -> Table:
    table = Table.grid(padding=(0, 2, 0, 0))
    table.add_column(style="bold", no_wrap=True, min_width=len("last events"))
    table.add_column()
    return table


def _grasp_rows(state: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    phase = str(state.get("phase"))
    notes = [f"mode {state.get('mode')}", _guard_text(state, phase)]
    if state.get("stopped_by_request"):
        notes.append("[yellow]stopped by request[/]")
    if state.get("slipping"):
        notes.append("[red]slipping[/]")
    yield "phase", f"[{'red' if phase == 'fault' else 'bold'}]{escape(phase)}[/] ({', '.join(notes)})"
    fault = state.get("fault")
    if fault:
        yield "fault", f"[red]{escape(fault['code'])}[/]: {escape(fault['observed'])}"
        yield "what to do", escape(fault["what_to_do"])
    if state.get("config_problem"):
        yield "config", f"[red]{escape(state['config_problem'])}[/]"
    yield "rotation", escape(_rotation_text(state))
    yield "grip", escape(_grip_text(state))
    arm = state.get("arm")
    if arm:
        stop = "protective stop" if arm["protective_stop"] else "emergency stop" if arm["emergency_stop"] else ""
        motion = f"moving at {arm['speed_mm_s']:.0f} mm/s" if arm["moving"] else "at rest"
        lifted_mm = state.get("lifted_mm")
        height = "no start of a lift known" if lifted_mm is None else f"{lifted_mm:.0f} mm above the start of the lift"
        yield "arm", f"{height}, {stop or motion}"
    else:
        yield "arm", "not connected" if state.get("has_arm", True) else 'none (arm.driver = "none")'


def _guard_text(state: Mapping[str, Any], phase: str) -> str:
    """Return whether the guard acts on slip. An object that is held in phase idle is not guarded."""
    if phase == "idle" and (state.get("gripper") or {}).get("holding"):
        return "[yellow]the held object is NOT guarded: `slipguard ctl guard on`[/]"
    return "guarding" if state.get("guarding") else "[yellow]not guarding[/]"


def _rotation_text(state: Mapping[str, Any]) -> str:
    rotation = state.get("rotation")
    if not rotation:
        return "no fresh frames from either finger"
    if rotation.get("rotation_deg") is None:
        return f"no estimate: {rotation.get('declined') or state.get('no_rotation_reason') or 'no contact'}"
    fingers = " and ".join(rotation.get("fingers", []))
    text = f"{rotation['rotation_deg']:+.1f}° ± {rotation['sigma_deg']:.1f}°, from {fingers}"
    shift_mm = rotation.get("shift_mm")
    if shift_mm is not None:
        text += f"; translational slip {shift_mm:+.1f} mm"
    return text + (f"; {rotation['conflict']}" if rotation.get("conflict") else "")


def _grip_text(state: Mapping[str, Any]) -> str:
    gripper = state.get("gripper")
    if not gripper:
        return "not connected"
    if gripper.get("fault"):
        return f"gripper fault: {gripper['fault']}"
    if not gripper["active"] and gripper["moving"]:
        return "gripper not active yet, moving: the jaws may open and close fully"
    if gripper.get("auto_released"):
        return "opened by an automatic release; before the next grasp see `slipguard ctl activate --help`"
    if not gripper["active"]:
        return "gripper not activated: see `slipguard ctl activate --help`"
    width = f"jaws {gripper['width_mm']:.0f} mm apart"
    if gripper["moving"]:
        return f"moving, {width}"
    if gripper["closed_on_nothing"]:
        return f"closed on nothing, {width}"
    if not gripper["holding"]:
        return f"empty, {width}"
    target_n = state.get("target_force_n") or 0.0
    if not gripper.get("force_known", True):
        least = f"at least {gripper['force_n']:.0f} N"
        known = f"{target_n:.0f} N last commanded" if target_n > gripper["force_n"] else least
        return f"holding, force unknown since the start ({known}), {width}"
    reached = target_n == 0.0 or abs(target_n - gripper["force_n"]) < 1.0
    target = "" if reached else f" (target {target_n:.0f} N)"
    return f"holding with {gripper['force_n']:.0f} N per finger{target}, {width}"


def _device_text(state: Mapping[str, Any], name: str, health: Mapping[str, Any]) -> str:
    """Return why the device is not ready, or what it reports."""
    if health.get("reason"):
        return str(health["reason"])
    finger = state.get("fingers", {}).get(name)
    if not finger:
        return ""
    estimate = finger.get("estimate") or {}
    texts = [str(finger.get("serial"))]
    if estimate:
        texts.append(f"contact of {estimate['contact_area_px']} px" if estimate.get("contact") else "no contact")
    if estimate.get("declined") and estimate.get("contact"):
        texts.append(str(estimate["declined"]))
    counts = finger.get("counts", {})
    texts.append(f"{counts.get('frames', 0)} frames")
    texts += [f"{counts[kind]} {kind}" for kind in ("corrupt", "torn", "frozen", "stalled", "late") if counts.get(kind)]
    texts += finger.get("remarks", [])
    gel = finger.get("gel") or {}
    if gel.get("action"):
        texts.append(f"gel {gel['status']}: {gel['observed']}; {gel['action']}")
    return ", ".join(texts)


def _event_lines(state: Mapping[str, Any]) -> Iterator[str]:
    """Return one line per kind of event, the newest last: newest time and figures, and how often since when."""
    kinds: dict[str, list[Mapping[str, Any]]] = {}
    for event in state.get("events", []):
        kind = without_figures(event["text"])
        kinds[kind] = [*kinds.pop(kind, []), event]
    for same in list(kinds.values())[-EVENTS_MAX:]:
        repeated = f" (×{len(same)} since {_clock_time(state, same[0])})" if len(same) > 1 else ""
        yield f"{_clock_time(state, same[-1])} {same[-1]['text']}{repeated}"
    if not kinds:
        yield "none yet"


def _clock_time(state: Mapping[str, Any], event: Mapping[str, Any]) -> str:
    """Return the time of an event on the clock of this machine; the daemon's own clock begins at its start."""
    ago_s = (state.get("now_s") or event["at_s"]) - event["at_s"]
    return time.strftime("%H:%M:%S", time.localtime(time.time() - ago_s))
