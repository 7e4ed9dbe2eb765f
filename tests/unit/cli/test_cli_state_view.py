"""The table of `slipguard ctl state`, in every state of the daemon."""

from __future__ import annotations

import asyncio
import json
import time
from typing import Any

import pytest
from rich.console import Console

from slipguard.cli.state_view import state_table
from slipguard.config import parse_config
from slipguard.daemon.api.snapshot import snapshot
from slipguard.daemon.loop.worker import FixedLatencyWorker
from slipguard.daemon.run import build_service
from slipguard.sim.world import World

ROTATION = {
    "rotation_deg": 12.34, "sigma_deg": 0.42, "fingers": ["left", "right"],
    "shift_mm": 0.31, "conflict": None, "declined": None,
}  # fmt: skip
HELD: dict[str, Any] = {
    "mode": "lift",
    "phase": "lifting",
    "guarding": True,
    "slipping": True,
    "target_force_n": 61.0,
    "no_rotation_reason": None,
    "fault": None,
    "rotation": ROTATION,
    "gripper": {
        "active": True, "moving": False, "holding": True, "closed_on_nothing": False,
        "width_mm": 28.0, "force_n": 40.2, "fault": None, "measured_at_s": 1.0,
    },
    "arm": {
        "height_mm": 52.7, "speed_mm_s": 50.0, "moving": True,
        "protective_stop": False, "emergency_stop": False, "measured_at_s": 1.0,
    },
    "lifted_mm": 51.2,
    "fingers": {
        "left": {
            "serial": "D20479",
            "estimate": {"contact": True, "contact_area_px": 2160, "declined": "round contact"},
            "counts": {"frames": 1280, "corrupt": 2, "frozen": 0, "stalled": 0, "late": 7},
        }
    },
    "devices": {
        "left": {"state": "ready", "reason": None},
        "right": {
            "state": "disconnected",
            "reason": "right: no DIGIT with serial number D20510; [plugged] in are D1 and D2",
        },
        "gripper": {"state": "error", "reason": "gripper: no answer within 50 ms"},
        "arm": {"state": "ready", "reason": None},
    },
    "now_s": 130.0,
    "events": [
        {"at_s": 10.0, "level": "info", "text": "gripped with 40 N"},
        {"at_s": 70.0, "level": "warning", "text": "slip of 1.2°"},
        {"at_s": 100.0, "level": "info", "text": "tightened"},
        {"at_s": 130.0, "level": "warning", "text": "slip of 3.4°"},
    ],
}  # fmt: skip


def shown(response: dict[str, Any], width: int = 80) -> str:
    console = Console(width=width, highlight=False, color_system=None)
    with console.capture() as capture:
        console.print(state_table(response))
    text = capture.get()
    assert all(len(line) <= width for line in text.splitlines())
    return " ".join(text.split())


def test_grasp_and_devices_are_shown() -> None:
    text = shown(HELD)
    assert "lifting (mode lift, guarding, slipping)" in text
    assert "rotation +12.3° ± 0.4°, from left and right; translational slip +0.3 mm" in text
    assert "grip holding with 40 N per finger (target 61 N), jaws 28 mm apart" in text
    assert "arm 51 mm above the start of the lift, moving at 50 mm/s" in text
    assert "left ready D20479, contact of 2160 px, round contact, 1280 frames, 2 corrupt, 7 late" in text
    assert "right disconnected right: no DIGIT with serial number D20510; [plugged] in are D1 and D2" in text
    assert "gripper error gripper: no answer within 50 ms" in text


def test_each_kind_of_event_is_one_line_with_its_newest_time_and_a_count(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TZ", "UTC")
    time.tzset()
    monkeypatch.setattr("slipguard.cli.state_view.time.time", lambda: 43200.0)
    assert shown(HELD).endswith(
        "last events 11:58:00 gripped with 40 N 11:59:30 tightened 12:00:00 slip of 3.4° (×2 since 11:59:00)"
    )


def test_a_fault_comes_with_what_to_do() -> None:
    fault = {
        "code": "frames lost",
        "observed": "no good frame for 0.3 s [left]",
        "what_to_do": "check the cables, then clear",
    }
    text = shown(HELD | {"phase": "fault", "fault": fault})
    assert "frames lost: no good frame for 0.3 s [left] what to do check the cables, then clear" in text


CHANGES: dict[str, tuple[dict[str, Any], str]] = {
    "blind": (
        {"rotation": ROTATION | {"rotation_deg": None, "sigma_deg": None, "declined": "round contact"}},
        "no estimate: round",
    ),
    "no rotation": ({"rotation": None}, "no fresh frames from either finger"),
    "contradiction": ({"rotation": ROTATION | {"conflict": "left +3°, right -4°"}}, "left +3°, right -4°"),
    "stopped": ({"phase": "holding", "stopped_by_request": True}, "guarding, stopped by request, slipping"),
    "not guarding": ({"guarding": False}, "not guarding"),
    "held and idle": (
        {"phase": "idle", "target_force_n": 0.0, "slipping": False},
        "idle (mode lift, the held object is NOT guarded: `slipguard ctl guard on`)",
    ),
    "taken as it is": ({"phase": "idle", "target_force_n": 0.0}, "holding with 40 N per finger, jaws 28 mm apart"),
    "idle": ({"phase": "idle", "slipping": False, "gripper": None}, "idle (mode lift, guarding)"),
    "no gripper": ({"gripper": None}, "grip not connected"),
    "gripper fault": ({"gripper": HELD["gripper"] | {"fault": "under-voltage"}}, "gripper fault: under-voltage"),
    "empty": ({"gripper": HELD["gripper"] | {"holding": False}}, "empty, jaws 28 mm apart"),
    "on nothing": ({"gripper": HELD["gripper"] | {"closed_on_nothing": True}}, "closed on nothing"),
    "unknown force": (
        {"gripper": HELD["gripper"] | {"force_n": 20.0, "force_known": False}, "target_force_n": 119.0},
        "holding, force unknown since the start (119 N last commanded), jaws 28 mm apart",
    ),
    "nothing known": (
        {"gripper": HELD["gripper"] | {"force_n": 20.0, "force_known": False}, "target_force_n": 20.0},
        "holding, force unknown since the start (at least 20 N), jaws 28 mm apart",
    ),
    "unknown start": ({"lifted_mm": None}, "no start of a lift known, moving at 50 mm/s"),
    "no arm": ({"arm": None}, "arm not connected"),
    "stopped arm": ({"arm": HELD["arm"] | {"protective_stop": True}}, "protective stop"),
    "new": ({"events": []}, "last events none yet"),
}


@pytest.mark.parametrize("change", CHANGES)
def test_every_other_state_has_a_text(change: str) -> None:
    different, expected = CHANGES[change]
    assert expected in shown(HELD | different)


def test_a_service_that_has_just_started_can_be_shown() -> None:
    async def main() -> dict[str, Any]:
        raw: dict[str, object] = {name: {"driver": "fake", "fake": {"draw": "inline"}} for name in ("left", "right")}
        service = build_service(
            parse_config(raw, where="test", sim=True),
            world=World(seed=0),
            make_worker=lambda name: FixedLatencyWorker(0.006),
        )
        response: dict[str, Any] = json.loads(json.dumps(snapshot(service, {})))
        return response

    text = shown(asyncio.run(main()))
    assert "idle (mode lift, guarding)" in text
    assert text.count("disconnected not tried yet") == 4


def test_remarks_of_a_sensor_are_shown() -> None:
    left = HELD["fingers"]["left"] | {"remarks": ["only 45 of 60 frames a second come from the camera"]}
    assert "only 45 of 60 frames a second come from the camera" in shown(HELD | {"fingers": {"left": left}})


def test_a_worn_or_drifted_gel_is_shown_with_what_to_do() -> None:
    gel = {"status": "worn", "observed": "2 lasting marks", "action": "clean the gel"}
    left = HELD["fingers"]["left"] | {"gel": gel}
    assert "gel worn: 2 lasting marks; clean the gel" in " ".join(shown(HELD | {"fingers": {"left": left}}).split())
    fine = HELD["fingers"]["left"] | {"gel": gel | {"status": "ok", "observed": "as it was", "action": ""}}
    assert "gel" not in shown(HELD | {"fingers": {"left": fine}}).split()
