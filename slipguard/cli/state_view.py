"""A daemon's state as a table for the terminal: the grasp, each device, and what to do about a fault."""

from __future__ import annotations

import time
from collections.abc import Iterator

from rich.console import Group, RenderableType
from rich.markup import escape
from rich.table import Table

from slipguard.control.messages import without_figures
from slipguard.control.state import Phase
from slipguard.daemon.api.state import State
from slipguard.daemon.loop.event_log import Event

HEALTH_COLORS = {"ready": "green", "error": "yellow", "disconnected": "red"}
EVENTS_MAX = 6


def state_table(state: State) -> RenderableType:
    """Return the state as a table of at most 80 columns, unless a reason is longer."""
    grasp = _two_columns()
    for name, text in _grasp_rows(state):
        grasp.add_row(name, text)
    devices = _two_columns()
    devices.add_column()
    for name, health in state.devices.items():
        shown = f"[{HEALTH_COLORS[health.state]}]{health.state}[/]"
        devices.add_row(name, shown, escape(health.reason or _finger_text(state, name)))
    events = _two_columns()
    for number, line in enumerate(_event_lines(state)):
        events.add_row("last events" if number == 0 else "", escape(line))
    return Group(grasp, "", devices, "", events)


def _two_columns() -> Table:
    table = Table.grid(padding=(0, 2, 0, 0))
    table.add_column(style="bold", no_wrap=True, min_width=len("last events"))
    table.add_column()
    return table


def _grasp_rows(state: State) -> Iterator[tuple[str, str]]:
    notes = [f"mode {state.mode}", _guard_text(state)]
    if state.stopped_by_request:
        notes.append("[yellow]stopped by request[/]")
    if state.slipping:
        notes.append("[red]slipping[/]")
    yield "phase", f"[{'red' if state.fault else 'bold'}]{state.phase.value}[/] ({', '.join(notes)})"
    if state.fault:
        yield "fault", f"[red]{escape(state.fault.code)}[/]: {escape(state.fault.observed)}"
        yield "what to do", escape(state.fault.what_to_do)
    if state.config_problem:
        yield "config", f"[red]{escape(state.config_problem)}[/]"
    yield "rotation", escape(_rotation_text(state))
    yield "grip", escape(_grip_text(state))
    yield "arm", _arm_text(state)


def _guard_text(state: State) -> str:
    """Return whether the guard acts on slip. An object that is held in phase idle is not guarded."""
    if state.phase is Phase.IDLE and state.gripper is not None and state.gripper.holding:
        return "[yellow]the held object is NOT guarded: `slipguard ctl guard on`[/]"
    return "guarding" if state.guarding else "[yellow]not guarding[/]"


def _rotation_text(state: State) -> str:
    rotation = state.rotation
    if rotation is None:
        return "no fresh frames from either finger"
    if rotation.rotation_deg is None or rotation.sigma_deg is None:
        return f"no estimate: {rotation.declined or state.no_rotation_reason or 'no contact'}"
    text = f"{rotation.rotation_deg:+.1f}° ± {rotation.sigma_deg:.1f}°, from {' and '.join(rotation.fingers)}"
    if rotation.shift_mm is not None:
        text += f"; translational slip {rotation.shift_mm:+.1f} mm"
    return text + (f"; {rotation.conflict}" if rotation.conflict else "")


def _grip_text(state: State) -> str:
    gripper, target_n = state.gripper, state.target_force_n
    if gripper is None:
        return "not connected"
    if gripper.fault:
        return f"gripper fault: {gripper.fault}"
    if not gripper.active and gripper.moving:
        return "gripper not active yet, moving: the jaws may open and close fully"
    if gripper.auto_released:
        return "opened by an automatic release; before the next grasp see `slipguard ctl activate --help`"
    if not gripper.active:
        return "gripper not activated: see `slipguard ctl activate --help`"
    width = f"jaws {gripper.width_mm:.0f} mm apart"
    if gripper.moving:
        return f"moving, {width}"
    if gripper.closed_on_nothing:
        return f"closed on nothing, {width}"
    if not gripper.holding:
        return f"empty, {width}"
    if not gripper.force_known:
        least = f"at least {gripper.force_n:.0f} N"
        known = f"{target_n:.0f} N last commanded" if target_n > gripper.force_n else least
        return f"holding, force unknown since the start ({known}), {width}"
    reached = target_n == 0.0 or abs(target_n - gripper.force_n) < 1.0
    target = "" if reached else f" (target {target_n:.0f} N)"
    used = "" if state.load_over_capacity is None else f", uses {state.load_over_capacity:.2f} of the grip"
    return f"holding with {gripper.force_n:.0f} N per finger{target}{used}, {width}"


def _arm_text(state: State) -> str:
    arm, lifted_mm = state.arm, state.lifted_mm
    if arm is None:
        return "not connected" if state.has_arm else 'none (arm.driver = "none")'
    height = "no start of a lift known" if lifted_mm is None else f"{lifted_mm:.0f} mm above the start of the lift"
    stop = "protective stop" if arm.protective_stop else "emergency stop" if arm.emergency_stop else ""
    return f"{height}, {stop or (f'moving at {arm.speed_mm_s:.0f} mm/s' if arm.moving else 'at rest')}"


def _finger_text(state: State, name: str) -> str:
    """Return what a finger reports; nothing for another device."""
    finger = state.fingers.get(name)
    if finger is None:
        return ""
    texts = [str(finger.serial)]
    estimate, counts, gel = finger.estimate, finger.counts, finger.gel
    if estimate is not None:
        texts.append(f"contact of {estimate.contact_area_px} px" if estimate.contact else "no contact")
        texts += [estimate.declined] if estimate.declined and estimate.contact else []
    lost = {kind: getattr(counts, kind) for kind in ("corrupt", "torn", "frozen", "stalled", "late")}
    texts += [f"{counts.frames} frames", *(f"{count} {kind}" for kind, count in lost.items() if count)]
    texts += finger.remarks
    if gel is not None and gel.action:
        texts.append(f"gel {gel.status}: {gel.observed}; {gel.action}")
    return ", ".join(texts)


def _event_lines(state: State) -> Iterator[str]:
    """Return one line per kind of event, the newest last: newest time and figures, and how often since when."""
    kinds: dict[str, list[Event]] = {}
    for event in state.events:
        kind = without_figures(event.text)
        kinds[kind] = [*kinds.pop(kind, []), event]
    for same in list(kinds.values())[-EVENTS_MAX:]:
        repeated = f" (×{len(same)} since {_clock_time(state, same[0])})" if len(same) > 1 else ""
        yield f"{_clock_time(state, same[-1])} {same[-1].text}{repeated}"
    if not kinds:
        yield "none yet"


def _clock_time(state: State, event: Event) -> str:
    """Return the time of an event on the clock of this machine; the daemon's own clock begins at its start."""
    ago_s = (state.now_s or event.at_s) - event.at_s
    return time.strftime("%H:%M:%S", time.localtime(time.time() - ago_s))
