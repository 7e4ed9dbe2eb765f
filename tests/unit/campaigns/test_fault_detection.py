"""When the fault campaign asks that a fault be named: each excuse with what ends it."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from slipguard.control.params import GuardParams
from slipguard.control.state import Phase
from slipguard.sim.injected_faults import InjectedFaults
from tests.campaigns.faults.detection import MonitoredFault, is_observable
from tests.campaigns.faults.kinds import KINDS, RANKS, PlannedFault


def newest(rotation_deg: float | None) -> SimpleNamespace:
    return SimpleNamespace(estimate=SimpleNamespace(rotation_deg=rotation_deg))


def rig(phase: Phase = Phase.HOLDING, rotations_deg: tuple[float, float] = (5.0, -5.0)) -> Any:
    """A cell in which everything is well and the object is held, 5 degrees from where it was gripped."""
    fingers = {
        name: SimpleNamespace(health=SimpleNamespace(state="ready", ready=True), newest=newest(rotation_deg))
        for name, rotation_deg in zip(("left", "right"), rotations_deg, strict=True)
    }
    gripper = SimpleNamespace(
        newest=SimpleNamespace(holding=True, closed_on_nothing=False), health=SimpleNamespace(ready=True)
    )
    service = SimpleNamespace(
        phase=phase,
        state=SimpleNamespace(grip=SimpleNamespace(closed=True), held=SimpleNamespace(slip=None)),
        fingers=fingers,
        gripper=gripper,
        arm=SimpleNamespace(newest=object()),
        observation=SimpleNamespace(fused=SimpleNamespace(fingers=("left", "right"))),
    )
    return SimpleNamespace(
        world=SimpleNamespace(faults=InjectedFaults()),
        service=service,
        params=SimpleNamespace(guard=GuardParams()),
        mirrored=set(),
        truth=SimpleNamespace(height_mm=40.0),
        now_s=10.0,
        alive=True,
    )


def watched(name: str, cell: Any, *, held: bool = True) -> MonitoredFault:
    """The fault begins on this cell."""
    kind = KINDS[name]
    if kind.fault == "mirrored":
        cell.mirrored.add(kind.device)
    elif kind.device in RANKS:
        cell.world.faults.fail(kind.device, kind.fault)
    return MonitoredFault(PlannedFault(kind, 0.0, np.inf), cell.now_s, held=held)


def seen(name: str, cell: Any) -> bool:
    return is_observable(watched(name, cell), cell)


PLAIN = [name for name, kind in KINDS.items() if kind.must_be_named and name not in ("arm.stuck", "object.taken")]


@pytest.mark.parametrize("name", PLAIN)
def test_without_an_excuse_a_fault_is_observable_at_once(name: str) -> None:
    assert seen(name, rig())


def test_a_removed_object_shows_in_a_camera_or_by_jaws_that_close_on_nothing() -> None:
    assert seen("object.taken", rig())
    assert not is_observable(watched("object.taken", rig(), held=False), rig()), "it was not guarded"
    cell = rig()
    for finger in ("left", "right"):
        cell.world.faults.fail(finger, "frozen")
    assert not seen("object.taken", cell)
    cell.service.gripper.newest.closed_on_nothing = True
    assert seen("object.taken", cell)
    cell.service.gripper.health.ready = False
    assert not seen("object.taken", cell), "the gripper does not respond"


def test_only_observable_time_counts_until_the_fault_is_named() -> None:
    cell = rig()
    one = watched("gripper.timeout", cell)
    for _ in range(40):
        one.update(cell, 0.01)
    cell.alive = False
    one.update(cell, 10.0)
    assert one.observable_s == pytest.approx(0.4)
    cell.alive = True
    one.read_line("left: no response")
    assert one.named_after_s is None, "another device"
    one.read_line("gripper: no response within 50 ms")
    one.update(cell, 10.0)
    assert one.named_after_s == pytest.approx(0.4)
    assert not one.unnamed
