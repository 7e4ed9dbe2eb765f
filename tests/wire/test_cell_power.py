"""An emergency stop takes the power of a gripper that has it from the robot's wrist, while it holds an object."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from cell_rig import cell, daemon, patiently, until, wait_for
from ur_scene import own_address

from slipguard.daemon.api.client import Client
from slipguard.daemon.api.requests import ActivateRequest, CalibrateRequest, GraspRequest, ReleaseRequest

OPTIONS = ("--object", "wrench", "--seed", 0, "--fps", 30, "--gripper-power", "wrist")


def wait(client: Client, good: Callable[[dict[str, Any]], object], otherwise: str) -> None:
    """Wait for a state; a fault is no failure."""
    until(lambda: good(client.state()), otherwise, lambda: client.state()["events"])


@pytest.mark.campaign
def test_the_object_is_released_without_closing_the_jaws(tmp_path: Path) -> None:
    with cell(tmp_path, own_address(69), *OPTIONS) as there, daemon(there) as client:
        patiently(lambda: client.submit(CalibrateRequest()))
        patiently(lambda: client.submit(GraspRequest()))
        wait_for(client, lambda state: state["phase"] == "holding" and not state["gripper"]["moving"], "no grip")
        there.order("fault arm.emergency_stop")
        wait(client, lambda state: state["phase"] == "fault" and state["gripper"] is None, "no loss of power")
        client.submit(ReleaseRequest(confirm=True))
        wait(client, lambda state: (state["fault"] or {}).get("code") == "not released", "not reported")
        there.order("clear arm.emergency_stop")
        wait(client, lambda state: state["gripper"] is not None, "no gripper")
        from_n = there.truth()[-1]["force"]
        assert from_n > 30.0, "the screw holds it"
        began = len(there.truth())
        client.submit(ReleaseRequest(confirm=True))
        wait(client, lambda state: state["phase"] == "idle", "not released")
        assert max(line["force"] for line in there.truth()[began:]) <= from_n
        assert there.truth()[-1]["force"] == 0.0
        there.order("take")
        patiently(lambda: client.submit(ActivateRequest(confirm=True)))
        wait(client, lambda state: state["gripper"]["active"], "not activated")
        patiently(lambda: client.submit(GraspRequest()))
