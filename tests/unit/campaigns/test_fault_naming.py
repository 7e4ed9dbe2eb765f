"""When the fault campaign asks that a fault be named: each excuse with what ends it."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from slipguard.control.params import GuardParams
from slipguard.control.state import Phase
from slipguard.sim.injected_faults import InjectedFaults
from tests.campaigns.faults import naming
from tests.campaigns.faults.kinds import KINDS, RANKS, PlannedFault
from tests.campaigns.faults.naming import TELLING_DEG, WITHIN_S, WatchedFault, can_be_seen


def told(rotation_deg: float | None) -> SimpleNamespace:
    return SimpleNamespace(estimate=SimpleNamespace(angle_deg=rotation_deg))


def rig(phase: Phase = Phase.HOLDING, rotations_deg: tuple[float, float] = (5.0, -5.0)) -> Any:
    """A cell in which everything is well and the object is held, 5 degrees from where it was gripped."""
    fingers = {
        name: SimpleNamespace(health=SimpleNamespace(state="ready", ready=True), newest=told(rotation_deg))
        for name, rotation_deg in zip(("left", "right"), rotations_deg, strict=True)
    }
    gripper = SimpleNamespace(
        newest=SimpleNamespace(holding=True, closed_on_nothing=False), health=SimpleNamespace(ready=True)
    )
    service = SimpleNamespace(
        phase=phase,
        state=SimpleNamespace(gripped=True, slip=None),
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


def watched(name: str, cell: Any, *, held: bool = True) -> WatchedFault:
    """The fault begins on this cell."""
    kind = KINDS[name]
    if kind.fault == "mirrored":
        cell.mirrored.add(kind.device)
    elif kind.device in RANKS:
        cell.world.faults.fail(kind.device, kind.fault)
    return WatchedFault(PlannedFault(kind, 0.0, np.inf), cell.now_s, held=held)


def seen(name: str, cell: Any) -> bool:
    return can_be_seen(watched(name, cell), cell)


PLAIN = [name for name, kind in KINDS.items() if kind.needs_a_name and name not in ("arm.stuck", "object.taken")]


@pytest.mark.parametrize("name", PLAIN)
def test_without_an_excuse_a_fault_can_be_seen_at_once(name: str) -> None:
    assert seen(name, rig())


@pytest.mark.parametrize("finger", ["left", "right"])
def test_a_frame_sent_twice_is_borne_in_silence(finger: str) -> None:
    one = watched(f"{finger}.duplicate", rig())
    one.seen_s = 60.0
    one.hear("left: whatever is said")
    assert (one.due, one.unnamed, one.named_after_s) == (False, False, None)


@pytest.mark.parametrize("device", list(RANKS))
def test_a_graver_fault_of_the_same_device_hides_and_a_lesser_one_does_not(device: str) -> None:
    for graver, lesser in zip(RANKS[device], RANKS[device][1:], strict=False):
        if lesser == "stuck" or {graver, lesser} == {"stamps_ahead", "stamps_behind"}:
            continue
        cell = rig()
        one, other = watched(f"{device}.{lesser}", cell), watched(f"{device}.{graver}", cell)
        assert not can_be_seen(one, cell), (graver, lesser)
        assert graver == "mirrored" or can_be_seen(other, cell), (graver, lesser)


def test_a_fault_of_another_device_hides_nothing() -> None:
    cell = rig()
    cell.world.faults.fail("right", "disconnect")
    assert seen("left.corrupt", cell)


def test_stamps_ahead_and_behind_undo_each_other() -> None:
    cell = rig()
    ahead, behind = watched("left.stamps_ahead", cell), watched("left.stamps_behind", cell)
    assert not can_be_seen(ahead, cell)
    assert not can_be_seen(behind, cell)
    cell.world.faults.repair("left", "stamps_ahead")
    assert can_be_seen(behind, cell)


@pytest.mark.parametrize(("fault", "visible"), [("corrupt", False), ("stall", False), ("disconnect", True)])
def test_a_sensor_that_is_being_opened_again_shows_only_that_it_is_gone(fault: str, visible: bool) -> None:
    cell = rig()
    cell.service.fingers["left"].health.state = "disconnected"
    assert seen(f"left.{fault}", cell) is visible


@pytest.mark.parametrize("fault", ["light", "mirrored"])
def test_where_nothing_is_held_a_finger_s_word_does_not_count(fault: str) -> None:
    assert not seen(f"left.{fault}", rig(Phase.IDLE))
    cell = rig(Phase.FAULT)
    assert seen(f"left.{fault}", cell)
    cell.service.state.gripped = False
    assert not can_be_seen(watched(f"left.{fault}", cell), cell)
    assert seen("left.corrupt", rig(Phase.IDLE))


def test_mirrored_pictures_show_once_both_have_turned_and_only_one_is_mirrored() -> None:
    assert not seen("left.mirrored", rig(rotations_deg=(5.0, 0.5 * TELLING_DEG)))
    cell = rig()
    assert seen("left.mirrored", cell)
    assert not seen("right.mirrored", cell), "two mirrored pictures agree"
    cell = rig()
    cell.service.observation.fused.fingers = ("left",)
    assert not seen("left.mirrored", cell)


def test_an_arm_is_stuck_once_it_has_gained_nothing_for_so_long() -> None:
    cell = rig(Phase.LIFTING)
    one = watched("arm.stuck", cell)
    assert not can_be_seen(one, cell)
    cell.now_s += 0.9 * GuardParams().stuck_s
    assert not can_be_seen(one, cell)
    cell.now_s += 0.2 * GuardParams().stuck_s
    assert can_be_seen(one, cell)
    cell.truth.height_mm += 2.0
    assert not can_be_seen(one, cell), "it has gained height"
    cell.now_s += 2.0 * GuardParams().stuck_s
    cell.service.state.slip = object()
    assert not can_be_seen(one, cell), "it waits for calm: it was not told to move"
    still = rig(Phase.HOLDING)
    assert not seen("arm.stuck", still)


def test_an_object_taken_shows_to_a_camera_or_by_jaws_that_close_on_nothing() -> None:
    assert seen("object.taken", rig())
    assert not can_be_seen(watched("object.taken", rig(), held=False), rig()), "nobody guarded it"
    cell = rig()
    for finger in ("left", "right"):
        cell.world.faults.fail(finger, "frozen")
    assert not seen("object.taken", cell)
    cell.service.gripper.newest.closed_on_nothing = True
    assert seen("object.taken", cell)
    cell.service.gripper.health.ready = False
    assert not seen("object.taken", cell), "the gripper is not heard"


def test_a_light_that_looks_like_a_contact_hides_an_object_taken_from_the_cameras() -> None:
    cell = rig()
    cell.world.faults.fail("left", "light")
    assert not seen("object.taken", cell)
    cell.world.faults.fail("left", "stall")
    assert seen("object.taken", cell), "no frame tells of that light any more, and the right camera is well"


def test_a_killed_daemon_is_told_of_once_the_next_one_hears_a_gripper_that_holds_something() -> None:
    cell = rig()
    cell.service.gripper.newest.holding = False
    assert not seen("daemon.killed", cell)
    cell.service.gripper.newest = None
    assert not seen("daemon.killed", cell)


def test_only_time_in_which_it_could_be_seen_counts_until_it_is_named() -> None:
    cell = rig()
    one = watched("gripper.timeout", cell)
    for _ in range(40):
        one.look(cell, 0.01)
    cell.alive = False
    one.look(cell, 10.0)
    assert one.seen_s == pytest.approx(0.4)
    cell.alive = True
    one.hear("left: no answer")
    assert one.named_after_s is None, "another device"
    one.hear("gripper: no answer within 50 ms")
    one.look(cell, 10.0)
    assert one.named_after_s == pytest.approx(0.4)
    assert not one.unnamed


def test_what_is_named_before_anybody_looked_counts_as_seen() -> None:
    one = watched("daemon.killed", rig())
    assert not one.due
    one.hear("an object is held with 60 N already: taken over as it is")
    assert one.due
    assert one.named_after_s == 0.0


def test_a_fault_named_too_late_or_never_is_unnamed() -> None:
    late = watched("gripper.timeout", rig())
    late.seen_s = WITHIN_S + 0.02
    assert late.unnamed
    late.hear("gripper: no answer within 50 ms")
    assert late.unnamed
    mended = watched("gripper.timeout", rig())
    mended.active = False
    mended.look(rig(), 10.0)
    assert mended.seen_s == 0.0


def test_the_rule_book_names_every_excuse() -> None:
    assert naming.__doc__ is not None
    for word in ("graver", "undoes", "opened again", "nothing is held", "both are", "stuck", "taken", "killed"):
        assert word in naming.__doc__
