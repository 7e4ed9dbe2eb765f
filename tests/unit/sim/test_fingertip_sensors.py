"""Sensors on the fingers: the jaws meet earlier, and gel on gel looks like a held object."""

from __future__ import annotations

import pytest

from slipguard.errors import CommandRefused
from slipguard.sim.scenario import Scenario
from slipguard.sim.world import World, WorldSettings

TIP_MM = 15.0
WRENCH_MM = 18.0


def world() -> World:
    return World(WorldSettings(fingertip_mm=TIP_MM))


def test_gels_meet_early_and_look_like_an_object() -> None:
    empty = world()
    empty.command_hold(0.0, 40.0)
    assert empty.view("left", 0.3).object_name == ""
    state, truth = empty.gripper_state(2.0), empty.truth(2.0)
    assert (state.holding, state.closed_on_nothing, state.width_mm) == (True, False, 2 * TIP_MM)
    assert truth.in_contact
    assert truth.force_n > 35.0
    for finger in ("left", "right"):
        assert empty.view(finger, 2.0).depth_mm > 0.1
    empty.command_release(2.0, 85.0)
    assert not empty.truth(4.0).in_contact
    assert empty.view("left", 4.0).depth_mm < 0.0


def test_a_limit_keeps_them_apart() -> None:
    empty = world()
    empty.command_hold(0.0, 40.0, 2 * TIP_MM + 1.0)
    assert empty.gripper_state(2.0).width_mm == 2 * TIP_MM + 1.0
    assert not empty.truth(2.0).in_contact


def test_an_object_is_gripped_where_the_gels_reach_it_and_its_loss_goes_on_to_the_gels() -> None:
    cell = world()
    cell.place(Scenario("wrench"), 0.0)
    with pytest.raises(CommandRefused, match="is between the jaws"):
        cell.place(Scenario("wrench"), 0.0)
    cell.command_hold(0.0, 60.0)
    assert cell.gripper_state(2.0).width_mm == pytest.approx(2 * TIP_MM + WRENCH_MM)
    assert cell.truth(2.0).in_contact
    cell.clear(2.0)
    after = cell.gripper_state(4.0)
    assert (after.width_mm, after.holding) == (2 * TIP_MM, True), "gel on gel, with all the force"
    assert cell.truth(4.0).force_n > 50.0


def test_what_does_not_fit_between_the_gels_is_refused() -> None:
    narrow = World(WorldSettings(fingertip_mm=35.0))
    with pytest.raises(CommandRefused, match=r"the jaws are 15\.0 mm apart"):
        narrow.place(Scenario("wrench"), 0.0)
