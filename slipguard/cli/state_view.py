"""A daemon's state on one screen, for people: what is held, how well each device is, what to do about a fault."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import groupby
from typing import Any

from rich.console import Group, RenderableType
from rich.markup import escape
from rich.table import Table

COLOUR = {"ready": "green", "error": "yellow", "disconnected": "red"}
SHOWN_EVENTS = 6


def state_table(answer: Mapping[str, Any]) -> RenderableType:
    """What `GET /state` answered, in at most 80 columns where no reason is longer."""
    grasp = _two_columns()
    for name, text in _grasp(answer):
        grasp.add_row(name, text)
    devices = _two_columns()
    devices.add_column()
    for name, health in answer.get("devices", {}).items():
        state = str(health.get("state"))
        colour = COLOUR.get(state, "white")
        devices.add_row(name, f"[{colour}]{escape(state)}[/]", escape(_device(answer, name, health)))
    events = _two_columns()
    for number, line in enumerate(_events(answer.get("messages", []))):
        events.add_row("last events" if number == 0 else "", escape(line))
    return Group(grasp, "", devices, "", events)


def _two_columns() -> Table:
    table = Table.grid(padding=(0, 2, 0, 0))
    table.add_column(style="bold", no_wrap=True, min_width=len("last events"))
    table.add_column()
    return table


def _grasp(answer: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    phase = str(answer.get("phase"))
    notes = [f"mode {answer.get('mode')}", _guard(answer, phase)]
    if answer.get("slipping"):
        notes.append("[red]slipping[/]")
    yield "phase", f"[{'red' if phase == 'fault' else 'bold'}]{escape(phase)}[/] ({', '.join(notes)})"
    fault = answer.get("fault")
    if fault:
        yield "fault", f"[red]{escape(fault['code'])}[/]: {escape(fault['observed'])}"
        yield "what to do", escape(fault["what_to_do"])
    yield "rotation", escape(_rotation(answer))
    yield "grip", escape(_grip(answer))
    arm = answer.get("arm")
    if arm:
        stop = "protective stop" if arm["protective_stop"] else "emergency stop" if arm["emergency_stop"] else ""
        moving = f"moving at {arm['speed_mm_s']:.0f} mm/s" if arm["moving"] else "at rest"
        yield "arm", f"{arm['height_mm']:.0f} mm above its start, {stop or moving}"
    else:
        yield "arm", "not known"


def _guard(answer: Mapping[str, Any], phase: str) -> str:
    """Whether slip would be acted on; what the jaws hold while the law is idle, nobody guards."""
    if phase == "idle" and (answer.get("gripper") or {}).get("holding"):
        return "[yellow]what is held is NOT guarded: `slipguard ctl guard on`[/]"
    return "guarding" if answer.get("guarding") else "[yellow]not guarding[/]"


def _rotation(answer: Mapping[str, Any]) -> str:
    rotation = answer.get("rotation")
    if not rotation:
        return "no finger sees anything now"
    if rotation.get("rotation_deg") is None:
        return f"cannot tell: {rotation.get('declined') or answer.get('no_rotation_reason') or 'no contact'}"
    text = f"{rotation['rotation_deg']:+.1f}° ± {rotation['sigma_deg']:.1f}°, seen by {' and '.join(rotation.get('fingers', []))}"
    shift_mm = rotation.get("shift_mm")
    if shift_mm is not None:
        text += f"; slid {shift_mm:+.1f} mm"
    return text + (f"; {rotation['conflict']}" if rotation.get("conflict") else "")


def _grip(answer: Mapping[str, Any]) -> str:
    gripper = answer.get("gripper")
    if not gripper:
        return "not known"
    if gripper.get("fault"):
        return f"gripper fault: {gripper['fault']}"
    if not gripper["active"]:
        return "gripper not activated"
    where = f"jaws {gripper['width_mm']:.0f} mm apart"
    if gripper["moving"]:
        return f"moving, {where}"
    if gripper["closed_on_nothing"]:
        return f"closed on nothing, {where}"
    if not gripper["holding"]:
        return f"empty, {where}"
    target_n = answer.get("target_force_n") or 0.0
    as_asked = target_n == 0.0 or abs(target_n - gripper["force_n"]) < 1.0
    asked = "" if as_asked else f" (asked for {target_n:.0f} N)"
    return f"holds with {gripper['force_n']:.0f} N per finger{asked}, {where}"


def _device(answer: Mapping[str, Any], name: str, health: Mapping[str, Any]) -> str:
    """Why it is not ready, or how it does."""
    if health.get("reason"):
        return str(health["reason"])
    finger = answer.get("fingers", {}).get(name)
    if not finger:
        return ""
    estimate = finger.get("estimate") or {}
    words = [str(finger.get("serial"))]
    if estimate:
        words.append(f"contact of {estimate['contact_area_px']} px" if estimate.get("contact") else "no contact")
    if estimate.get("declined") and estimate.get("contact"):
        words.append(str(estimate["declined"]))
    counts = finger.get("counts", {})
    words.append(f"{counts.get('frames', 0)} frames")
    words += [f"{counts[kind]} {kind}" for kind in ("corrupt", "frozen", "stalled", "late") if counts.get(kind)]
    words += finger.get("remarks", [])
    gel = finger.get("gel") or {}
    if gel.get("action"):
        words.append(f"gel {gel['status']}: {gel['observed']}; {gel['action']}")
    return ", ".join(words)


def _events(said: list[str]) -> Iterator[str]:
    """The newest last; what was said several times in a row is told once."""
    runs = [(line, len(list(same))) for line, same in groupby(said)]
    for line, times in runs[-SHOWN_EVENTS:]:
        yield line if times == 1 else f"{line} (×{times})"
    if not runs:
        yield "nothing yet"
