"""A whole guarded lift on the wire: the daemon, the emulated cell, the real drivers between them, in both modes.

Without the guard this object rotates and falls: it needs more force than the first grip gives.
"""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from cell_rig import Cell, cell, daemon, patiently, pause, wait_for
from ur_scene import own_address

from slipguard.cli.app import run
from slipguard.daemon.api.client import Client
from slipguard.daemon.api.requests import CalibrateRequest, GraspRequest, LiftRequest, LowerRequest, ReleaseRequest
from slipguard.doctor import run_checks

OPTIONS = ("--object", "wrench", "--seed", 0, "--fps", 30, "--height-mm", 80)
ROTATION_MAX_DEG = 25.0


def grasp(client: Client) -> None:
    patiently(lambda: client.submit(CalibrateRequest()))
    patiently(lambda: client.submit(GraspRequest()))
    wait_for(client, lambda state: state["phase"] == "holding" and not state["gripper"]["moving"], "no grip")


def put_down(client: Client) -> None:
    client.submit(ReleaseRequest(confirm=True))
    wait_for(client, lambda state: state["phase"] == "idle" and state["gripper"]["width_mm"] > 80.0, "no release")


def check(cell: Cell) -> list[dict[str, Any]]:
    """Held, the rotation arrested, and the grip only ever risen while it was up."""
    truth = cell.truth()
    assert not [line for line in truth if line["dropped"]], "it fell"
    up = [line for line in truth if line["height"] > 1.0]
    assert max(line["height"] for line in up) > 70.0
    assert 2.0 < max(abs(line["rotation"]) for line in up) < ROTATION_MAX_DEG
    assert up[0]["force"] < up[0]["needed"] < up[-1]["force"], "the first grip was too weak, the last is enough"
    for before, after in pairwise(up):
        assert after["force"] >= before["force"] - 0.01
    return up


def ask_the_doctor(there: Cell, capfd: pytest.CaptureFixture[str]) -> dict[tuple[str, str], dict[str, str]]:
    """While the daemon has the devices."""
    run(["doctor", "--config", str(there.config), "--json"])
    return {(one["subject"], one["check"]): one for one in json.loads(capfd.readouterr().out)["checks"]}


@pytest.mark.campaign
@pytest.mark.realtime
def test_a_lift_by_slipguard(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run_checks, "OBSERVE_S", 0.5)
    with cell(tmp_path, own_address(62), *OPTIONS) as there, daemon(there) as client:
        grasp(client)
        said = ask_the_doctor(there, capfd)
        assert "no device was opened" in said["daemon", "daemon"]["observed"]
        for name in ("left", "right", "gripper", "arm"):
            (known,) = (
                one for key, one in said.items() if key[0] == name and "in use by the daemon" in one["observed"]
            )
            assert known["status"] == "ok"
        assert "p50" in said["gripper", "round trip"]["observed"]
        assert "holding something" in said["gripper", "condition"]["observed"]
        assert said["arm", "program"]["status"] == "ok", "the script that runs is slipguard's own"
        client.submit(LiftRequest())
        wait_for(client, lambda state: state["phase"] == "lifting", "no lift")
        wait_for(client, lambda state: state["phase"] == "holding", "the lift does not end")
        check(there)
        client.submit(LowerRequest())
        wait_for(client, lambda state: state["phase"] == "holding" and state["arm"]["height_mm"] < 1.0, "still up")
        assert not there.events("released"), "no release was requested"
        put_down(client)
        assert len(there.events("released")) == 1
        assert not [line for line in there.truth() if line["dropped"]]


@pytest.mark.campaign
@pytest.mark.realtime
@pytest.mark.parametrize("gripper", ["usb", "forwarder", "urcap"])
def test_a_lift_by_the_robots_own_program(tmp_path: Path, gripper: str) -> None:
    options = (*OPTIONS, "--mode", "guard", "--play-again-s", 1.0, "--gripper", gripper)
    with cell(tmp_path, own_address(63), *options) as there:
        with daemon(there) as client:
            grasp(client)
            wait_for(client, lambda state: state["arm"]["height_mm"] > 75.0, "the program does not lift")
            pause(0.3)
            check(there)
            assert there.events("paused"), "the arm was never stopped, although the object rotated"
            wait_for(client, lambda state: state["arm"]["height_mm"] < 1.0, "the program does not come down")
            assert not there.events("released")
            put_down(client)
        ended = [event["why"] for event in there.events("ended")]
        assert not ended, f"another program was ended: {ended}"
