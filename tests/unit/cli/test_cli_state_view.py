"""The table of `slipguard ctl state`, in every state of the daemon."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import pytest
from fake_daemon_api import holding_state
from rich.console import Console

from slipguard.cli.state_view import state_table
from slipguard.config import sim_config
from slipguard.control.finger_fusion import FusedEstimate
from slipguard.control.reports import Fault, FaultCode
from slipguard.daemon.api.snapshot import snapshot
from slipguard.daemon.api.state import FingerState, RecordingState, State
from slipguard.daemon.loop.capture import FrameCounts
from slipguard.daemon.loop.device_health import Health
from slipguard.daemon.loop.event_log import Event
from slipguard.daemon.loop.gel_condition import GelCondition, GelStatus
from slipguard.daemon.loop.worker import FixedLatencyWorker
from slipguard.daemon.run import build_service
from slipguard.devices import FINGERS, ArmState, GripperState
from slipguard.perception.background import GelChange
from slipguard.perception.estimate import Estimate
from slipguard.sim.world import World

ROTATION = FusedEstimate(True, True, 129.9, 129.9, FINGERS, 12.34, 0.42, shift_mm=0.31, newest_at_s=129.9)
GRIPPER = GripperState(True, False, True, False, 28.0, 40.2, None, 129.9)
ARM = ArmState(52.7, 50.0, True, False, False, 129.9)
UNCHANGED = GelChange((0.0, 0.0, 0.0), 0.0, (), 0)
WORN = GelCondition(GelStatus.WORN, UNCHANGED, UNCHANGED, 0.4, "2 lasting marks", "clean the gel")
LEFT = FingerState(
    serial="D20479",
    estimate=Estimate(1280, 129.9, 129.9, True, 2160, "registration", declined="round contact"),
    frames_per_s=60.0,
    age_s=0.02,
    counts=FrameCounts(frames=1280, corrupt=2, late=7),
    remarks=["only 45 of 60 frames a second come from the camera"],
    gel=WORN,
)
MISSING = "right: no DIGIT with serial number D20510; [plugged] in are D1 and D2"
HELD: dict[str, Any] = {
    "phase": "lifting",
    "slipping": True,
    "target_force_n": 61.0,
    "rotation": ROTATION,
    "gripper": GRIPPER,
    "arm": ARM,
    "lifted_mm": 51.2,
    "fingers": {"left": LEFT},
    "devices": {
        "left": Health("left", "ready", ""),
        "right": Health("right", "disconnected", MISSING),
        "gripper": Health("gripper", "error", "no answer within 50 ms"),
        "arm": Health("arm", "ready", ""),
    },
    "now_s": 130.0,
    "events": [
        Event(10.0, "info", "gripped with 40 N"),
        Event(70.0, "warning", "slip of 1.2°"),
        Event(100.0, "info", "tightened"),
        Event(130.0, "warning", "slip of 3.4°"),
    ],
}
FAULT = Fault(FaultCode.FRAMES_LOST, "no good frame for 0.3 s [left]", "check the cables, then clear")


def shown(state: State, width: int = 80) -> str:
    console = Console(width=width, highlight=False, color_system=None)
    with console.capture() as capture:
        console.print(state_table(state))
    text = capture.get()
    assert all(len(line) <= width for line in text.splitlines())
    return " ".join(text.split())


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, "lifting (mode lift, guarding, slipping)"),
        ({}, "rotation +12.3° ± 0.4°, from left and right; translational slip +0.3 mm"),
        ({}, "grip holding with 40 N per finger (target 61 N), jaws 28 mm apart"),
        ({}, "arm 51 mm above the start of the lift, moving at 50 mm/s"),
        ({}, "left ready D20479, contact of 2160 px, round contact, 1280 frames, 2 corrupt, 7 late"),
        ({}, "only 45 of 60 frames a second come from the camera"),
        ({}, "gel worn: 2 lasting marks; clean the gel"),
        ({}, f"right disconnected {MISSING}"),
        ({}, "gripper error no answer within 50 ms"),
        ({"phase": "fault", "fault": FAULT}, f"{FAULT.code}: {FAULT.observed} what to do {FAULT.what_to_do}"),
        ({"config_problem": "config.toml: guard.x: no such key"}, "config config.toml: guard.x: no such key"),
        (
            {"rotation": replace(ROTATION, rotation_deg=None, sigma_deg=None, declined="round contact")},
            "no estimate: round",
        ),
        ({"rotation": None}, "no fresh frames from either finger"),
        ({"rotation": replace(ROTATION, conflict="left +3°, right -4°")}, "left +3°, right -4°"),
        ({"phase": "holding", "stopped_by_request": True}, "guarding, stopped by request, slipping"),
        ({"guarding": False}, "not guarding"),
        ({"phase": "idle", "slipping": False}, "idle (mode lift, the held object is NOT guarded: `slipguard ctl guard"),
        ({"phase": "idle", "target_force_n": 0.0}, "holding with 40 N per finger, jaws 28 mm apart"),
        ({"load_over_capacity": 0.618}, "(target 61 N), uses 0.62 of the grip, jaws 28 mm apart"),
        ({"phase": "idle", "slipping": False, "gripper": None}, "idle (mode lift, guarding)"),
        ({"gripper": None}, "grip not connected"),
        ({"gripper": replace(GRIPPER, fault="under-voltage")}, "gripper fault: under-voltage"),
        ({"gripper": replace(GRIPPER, active=False)}, "gripper not activated"),
        ({"gripper": replace(GRIPPER, active=False, auto_released=True)}, "opened by an automatic release"),
        ({"gripper": replace(GRIPPER, holding=False)}, "empty, jaws 28 mm apart"),
        ({"gripper": replace(GRIPPER, closed_on_nothing=True)}, "closed on nothing"),
        (
            {"gripper": replace(GRIPPER, force_n=20.0, force_known=False), "target_force_n": 119.0},
            "holding, force unknown since the start (119 N last commanded), jaws 28 mm apart",
        ),
        (
            {"gripper": replace(GRIPPER, force_n=20.0, force_known=False), "target_force_n": 20.0},
            "holding, force unknown since the start (at least 20 N), jaws 28 mm apart",
        ),
        ({"lifted_mm": None}, "no start of a lift known, moving at 50 mm/s"),
        ({"arm": None}, "arm not connected"),
        ({"arm": None, "has_arm": False}, 'none (arm.driver = "none")'),
        ({"arm": replace(ARM, protective_stop=True)}, "protective stop"),
        ({"events": []}, "last events none yet"),
    ],
)
def test_every_state_has_a_text(changes: dict[str, Any], expected: str) -> None:
    assert expected in shown(holding_state(**HELD | changes))


def test_each_kind_of_event_is_one_line_with_its_newest_time_and_a_count(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TZ", "UTC")
    time.tzset()
    monkeypatch.setattr("slipguard.cli.state_view.time.time", lambda: 43200.0)
    assert shown(holding_state(**HELD)).endswith(
        "last events 11:58:00 gripped with 40 N 11:59:30 tightened 12:00:00 slip of 3.4° (×2 since 11:59:00)"
    )


async def test_a_service_that_has_just_started_can_be_shown() -> None:
    service = build_service(
        sim_config("inline"), world=World(seed=0), make_worker=lambda name: FixedLatencyWorker(0.006)
    )
    sent = snapshot(service, {}, RecordingState()).model_dump_json()
    text = shown(State.model_validate_json(sent))
    assert "idle (mode lift, guarding)" in text
    assert text.count("disconnected not tried yet") == 4
