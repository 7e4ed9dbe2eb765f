"""When the fault campaign asks that a fault be named: each excuse with what ends it."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from slipguard.control.params import GuardParams
from slipguard.control.state import Phase
from slipguard.sim.injected_faults import InjectedFaults
from tests.campaigns.faults import detection
from tests.campaigns.faults.detection import OBSERVABLE_DEG, WITHIN_S, MonitoredFault, is_observable
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


@pytest.mark.parametrize("finger", ["left", "right"])
def test_a_frame_sent_twice_is_borne_in_silence(finger: str) -> None:
    one = watched(f"{finger}.duplicate", rig())
    one.observable_s = 60.0
    one.read_line("left: any message")
    assert (one.due, one.unnamed, one.named_after_s) == (False, False, None)


@pytest.mark.parametrize("device", list(RANKS))
def test_a_more_severe_fault_of_the_same_device_hides_and_a_lesser_one_does_not(device: str) -> None:
    for severe, lesser in zip(RANKS[device], RANKS[device][1:], strict=False):
        if lesser == "stuck" or {severe, lesser} == {"stamps_ahead", "stamps_behind"}:
            continue
        cell = rig()
        one, other = watched(f"{device}.{lesser}", cell), watched(f"{device}.{severe}", cell)
        assert not is_observable(one, cell), (severe, lesser)
        assert severe == "mirrored" or is_observable(other, cell), (severe, lesser)


def test_a_fault_of_another_device_hides_nothing() -> None:
    cell = rig()
    cell.world.faults.fail("right", "disconnect")
    assert seen("left.corrupt", cell)


def test_time_stamps_ahead_and_behind_cancel_each_other() -> None:
    cell = rig()
    ahead, behind = watched("left.stamps_ahead", cell), watched("left.stamps_behind", cell)
    assert not is_observable(ahead, cell)
    assert not is_observable(behind, cell)
    cell.world.faults.repair("left", "stamps_ahead")
    assert is_observable(behind, cell)


@pytest.mark.parametrize(("fault", "visible"), [("corrupt", False), ("stall", False), ("disconnect", True)])
def test_a_sensor_being_reopened_shows_only_its_disconnection(fault: str, visible: bool) -> None:
    cell = rig()
    cell.service.fingers["left"].health.state = "disconnected"
    assert seen(f"left.{fault}", cell) is visible


@pytest.mark.parametrize("fault", ["light", "mirrored"])
def test_a_finger_s_estimate_does_not_count_when_nothing_is_held(fault: str) -> None:
    assert not seen(f"left.{fault}", rig(Phase.IDLE))
    cell = rig(Phase.FAULT)
    assert seen(f"left.{fault}", cell)
    cell.service.state.grip.closed = False
    assert not is_observable(watched(f"left.{fault}", cell), cell)
    assert seen("left.corrupt", rig(Phase.IDLE))


def test_mirrored_images_are_observable_after_both_fingers_rotated_and_only_one_is_mirrored() -> None:
    assert not seen("left.mirrored", rig(rotations_deg=(5.0, 0.5 * OBSERVABLE_DEG)))
    cell = rig()
    assert seen("left.mirrored", cell)
    assert not seen("right.mirrored", cell), "two mirrored images agree"
    cell = rig()
    cell.service.observation.fused.fingers = ("left",)
    assert not seen("left.mirrored", cell)


def test_an_arm_is_stuck_after_gaining_no_height_for_the_stuck_timeout() -> None:
    cell = rig(Phase.LIFTING)
    one = watched("arm.stuck", cell)
    assert not is_observable(one, cell)
    cell.now_s += 0.9 * GuardParams().tuning.stuck_timeout_s
    assert not is_observable(one, cell)
    cell.now_s += 0.2 * GuardParams().tuning.stuck_timeout_s
    assert is_observable(one, cell)
    cell.truth.height_mm += 2.0
    assert not is_observable(one, cell), "it has gained height"
    cell.now_s += 2.0 * GuardParams().tuning.stuck_timeout_s
    cell.service.state.held.slip = object()
    assert not is_observable(one, cell), "it waits until settled: it was not commanded to move"
    still = rig(Phase.HOLDING)
    assert not seen("arm.stuck", still)


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


def test_a_light_that_resembles_a_contact_hides_a_removed_object_from_the_cameras() -> None:
    cell = rig()
    cell.world.faults.fail("left", "light")
    assert not seen("object.taken", cell)
    cell.world.faults.fail("left", "stall")
    assert seen("object.taken", cell), "no frame shows that light any more, and the right camera works"


def test_a_killed_daemon_is_observable_after_the_next_one_reads_a_holding_gripper() -> None:
    cell = rig()
    cell.service.gripper.newest.holding = False
    assert not seen("daemon.killed", cell)
    cell.service.gripper.newest = None
    assert not seen("daemon.killed", cell)


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


def test_a_fault_named_at_once_counts_as_observable() -> None:
    one = watched("daemon.killed", rig())
    assert not one.due
    one.read_line("an object is already held with 60 N: taken over as it is")
    assert one.due
    assert one.named_after_s == 0.0


def test_a_fault_named_too_late_or_never_is_unnamed() -> None:
    late = watched("gripper.timeout", rig())
    late.observable_s = WITHIN_S + 0.02
    assert late.unnamed
    late.read_line("gripper: no response within 50 ms")
    assert late.unnamed
    mended = watched("gripper.timeout", rig())
    mended.active = False
    mended.update(rig(), 10.0)
    assert mended.observable_s == 0.0


def test_the_module_documents_every_exception() -> None:
    assert detection.__doc__ is not None
    for word in ("severe", "cancels", "reopened", "nothing is held", "both are", "stuck", "taken", "killed"):
        assert word in detection.__doc__
