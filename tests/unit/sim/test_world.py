"""The shared world: objects are held, rotate, slip and drop consistently."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import pytest
from world_scene import QUICK, T0, bar, follow, grasped, make

from slipguard.sim.cell import CellState, is_static
from slipguard.sim.friction import SoftPad, needed_force_n
from slipguard.sim.gripper_plant import GripperPlant
from slipguard.sim.object_motion import ObjectMotion
from slipguard.sim.scenario import Scenario
from slipguard.sim.world import World, WorldSettings, WorldTruth


def test_an_empty_world_has_nothing_to_show() -> None:
    world = make()
    assert world.gripper_state(T0).width_mm == 85.0
    assert world.arm_state(T0).height_mm == 0.0
    assert world.view("left", T0).depth_mm < 0
    truth = world.truth(T0)
    assert truth.object_name is None
    assert not truth.on_table
    assert truth.dropped is None


def test_contact_comes_smoothly_while_the_fingers_close() -> None:
    world = make()
    world.place(Scenario("bar", gripper=QUICK), T0)
    assert world.view("left", T0).depth_mm == pytest.approx(-27.5)
    world.command_hold(T0, 40.0)
    depths = [world.view("left", T0 + i * 0.002).depth_mm for i in range(500)]
    assert all(b >= a for a, b in pairwise(depths))
    touched = [depth for depth in depths if depth > 0]
    assert max(b - a for a, b in pairwise(touched)) < 0.1
    assert depths[-1] == pytest.approx(math.sqrt(world.truth(T0 + 1.0).force_n / 40.0))


def test_a_sufficient_grip_lifts_without_rotation() -> None:
    world, now_s = grasped(30.0)
    world.command_lift(now_s, 60.0, 50.0)
    end = follow(world, now_s, 3.0)[-1]
    assert abs(end.rotation_deg) < 0.2
    assert end.height_mm == 60.0
    assert not end.on_table
    assert end.load_n == pytest.approx(0.35 * 9.80665 / 2, rel=1e-6)
    assert end.needed_force_n == pytest.approx(needed_force_n(bar(), SoftPad()))


def test_with_a_weak_grip_the_object_rotates_until_it_is_tightened() -> None:
    world, now_s = grasped(20.0)
    world.command_lift(now_s, 60.0, 50.0)

    def guard(truth: WorldTruth) -> None:
        if truth.rotation_deg > 2.0:
            world.command_hold(truth.time_s, 34.0)

    truths = follow(world, now_s, 3.0, guard)
    assert 2.0 < truths[-1].rotation_deg < 8.0
    assert truths[-1].rate_deg_s == pytest.approx(0.0, abs=1e-3)
    assert truths[-1].dropped is None


def test_the_two_images_mirror_each_other() -> None:
    world, now_s = grasped(20.0, x_mm=1.5, y_mm=-0.5, angle_deg=30.0)
    world.command_lift(now_s, 60.0, 50.0)
    now_s += 1.0
    left, right, truth = world.view("left", now_s), world.view("right", now_s), world.truth(now_s)
    assert truth.rotation_deg > 5.0
    assert left.angle_deg == pytest.approx(30.0 + truth.rotation_deg) == truth.angle_deg
    assert right.angle_deg == -left.angle_deg == -truth.angle_deg
    assert (left.x_mm, right.x_mm) == (1.5, -1.5)
    assert left.y_mm == right.y_mm == pytest.approx(-0.5 - truth.slip_mm)
    assert left.rate_deg_s == -right.rate_deg_s == truth.rate_deg_s


def test_the_lever_determines_the_direction_of_rotation() -> None:
    ends = []
    for sign in (1, -1):
        world, now_s = grasped(20.0, lever_sign=sign)
        world.command_lift(now_s, 60.0, 50.0)
        ends.append(follow(world, now_s, 1.0)[-1])
    assert ends[0].rotation_deg == -ends[1].rotation_deg > 5.0
    assert ends[0].slip_deg == -ends[1].slip_deg


def test_a_large_rotation_is_a_drop() -> None:
    world, now_s = grasped(20.0, bar(mass_kg=2.0, lever_mm=40.0))
    world.command_lift(now_s, 200.0, 100.0)
    end = follow(world, now_s, 4.0)[-1]
    assert end.dropped == "rotated more than 60 deg"
    assert not end.in_contact
    assert world.view("left", now_s + 4.0).depth_mm <= 0
    assert world.gripper_state(now_s + 6.0).closed_on_nothing


def test_with_a_grip_too_weak_for_the_weight_the_object_slips_and_drops() -> None:
    world, now_s = grasped(20.0, bar(mass_kg=2.0, lever_mm=0.0, friction=0.4))  # needs 24.5 N
    world.command_lift(now_s, 5.0, 50.0)
    sliding = follow(world, now_s, 1.0)[-1]
    assert sliding.slip_mm > 2.0
    assert sliding.on_table
    assert sliding.dropped is None
    world.command_lift(now_s + 1.0, 60.0, 50.0)
    end = follow(world, now_s + 1.0, 2.0)[-1]
    assert end.dropped == "contact lost"
    assert end.rotation_deg == 0.0


def test_translational_slip_shows_in_the_images_and_tightening_stops_it() -> None:
    world, now_s = grasped(20.0, bar(mass_kg=2.0, lever_mm=0.0, friction=0.4))
    world.command_lift(now_s, 60.0, 20.0)

    def guard(truth: WorldTruth) -> None:
        if truth.slip_mm > 1.0:
            world.command_hold(truth.time_s, 45.0)

    end = follow(world, now_s, 5.0, guard)[-1]
    assert end.dropped is None
    assert 1.0 < end.slip_mm < 8.0
    assert not end.on_table
    assert world.view("left", now_s + 5.0).y_mm == pytest.approx(-end.slip_mm)


def test_a_jerk_beyond_friction_makes_it_slide_and_more_weight_lets_it_fall() -> None:
    world = World(
        replace(WorldSettings(), arm=replace(WorldSettings().arm, acceleration_mm_s2=20_000.0)),
        lookup=lambda name: bar(mass_kg=2.0, lever_mm=0.0, friction=0.4),
    )
    world.place(Scenario("bar", gripper=QUICK), T0)
    world.command_hold(T0, 26.0)
    world.command_lift(T0 + 1.5, 10.0, 10.0)
    assert follow(world, T0 + 1.5, 2.0)[-1].dropped is None
    world.command_lift(T0 + 4.0, 200.0, 250.0)
    jerked = follow(world, T0 + 4.0, 1.0)[-1]
    assert jerked.dropped is None
    assert 0.1 < jerked.slip_mm < 12.0
    world.add_mass(T0 + 5.0, 1.0)
    assert follow(world, T0 + 5.0, 1.0)[-1].dropped == "contact lost"


def test_opening_in_the_air_is_a_drop_and_on_the_table_is_not() -> None:
    world, now_s = grasped(30.0)
    world.command_lift(now_s, 60.0, 100.0)
    world.command_release(now_s + 2.0, 85.0)
    assert world.truth(now_s + 4.0).dropped == "contact lost"

    world, now_s = grasped(30.0)
    world.command_lift(now_s, 60.0, 100.0)
    world.command_lift(now_s + 2.0, -60.0, 100.0)
    world.command_release(now_s + 4.0, 85.0)
    end = world.truth(now_s + 6.0)
    assert end.dropped is None
    assert end.on_table
    assert not end.in_contact
    assert world.view("left", now_s + 6.0).depth_mm < 0


def test_set_down_and_grasped_again_it_starts_afresh() -> None:
    world, now_s = grasped(20.0)
    world.command_lift(now_s, 30.0, 50.0)
    assert world.truth(now_s + 1.0).rotation_deg > 5.0
    world.command_lift(now_s + 1.0, -29.0, 50.0)
    world.command_release(now_s + 3.0, 85.0)
    lying = world.truth(now_s + 5.0)
    assert lying.dropped is None
    assert lying.rotation_deg > 0.1
    world.command_hold(now_s + 5.0, 30.0)
    again = world.truth(now_s + 7.0)
    assert again.in_contact
    assert again.rotation_deg == pytest.approx(0.0, abs=1e-6)


def test_an_even_motion_is_not_taken_for_rest() -> None:
    gripper = GripperPlant(width_mm=30.0, force_n=30.0, holding=True)
    rotating = CellState(gripper, QUICK, motion=ObjectMotion(rate_rad_s=0.5), held=True)
    assert not is_static(rotating, rotating, T0)
    resting = replace(rotating, motion=ObjectMotion(rotation_rad=0.5))
    assert is_static(resting, resting, T0)


def test_a_dropped_object_stays_dropped_until_cleared() -> None:
    world, now_s = grasped(30.0)
    world.command_lift(now_s, 60.0, 100.0)
    world.command_release(now_s + 2.0, 85.0)
    world.command_hold(now_s + 4.0, 60.0)
    assert world.truth(now_s + 6.0).dropped == "contact lost"
    world.command_release(now_s + 6.0, 85.0)
    world.clear(now_s + 8.0)
    assert world.truth(now_s + 8.0).dropped is None
    world.place(Scenario("bar", gripper=QUICK), now_s + 8.0)
    world.command_hold(now_s + 8.0, 30.0)
    assert world.truth(now_s + 10.0).in_contact
