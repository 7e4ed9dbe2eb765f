"""The shared world: objects are held, rotate, slip and drop consistently, for any caller, call rate and fault."""

from __future__ import annotations

import math
import random
from dataclasses import replace
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from world_scene import QUICK, T0, bar, follow, grasped, make

from slipguard.errors import CommandRefused, InputError
from slipguard.limit_surface import GRAVITY_M_S2
from slipguard.sim.friction import SoftPad
from slipguard.sim.injected_faults import KINDS, InjectedFaults
from slipguard.sim.object_motion import ExternalLoad, GraspedBody, ObjectMotion, advance
from slipguard.sim.scenario import Scenario, scenario
from slipguard.sim.world import World, WorldSettings, WorldTruth


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


def test_answers_do_not_depend_on_how_often_it_is_asked() -> None:
    def story(extra: random.Random | None) -> WorldTruth:
        world, now_s = grasped(20.0, gel=SoftPad(0.3, 3.0))
        world.command_lift(now_s, 60.0, 50.0)
        if extra is not None:
            for at_s in sorted(extra.uniform(now_s, now_s + 1.0) for _ in range(300)):
                world.view(extra.choice(("left", "right")), at_s)
        world.command_hold(now_s + 1.0, 50.0)
        return world.truth(now_s + 2.0)

    assert story(None) == story(random.Random(1)) == story(random.Random(2))


def test_a_held_object_at_rest_costs_nothing_for_a_day() -> None:
    world, now_s = grasped(30.0)
    world.command_lift(now_s, 60.0, 50.0)
    before = world.truth(now_s + 5.0)
    after = world.truth(now_s + 86_400.0)  # 86 million steps, if it took them
    assert after.rotation_deg == pytest.approx(before.rotation_deg, abs=1e-6)
    assert world.command_hold(now_s + 86_400.0, 60.0) > 59.0
    assert world.truth(now_s + 86_402.0).force_n > 59.0


def test_safety_stops_brake_the_arm_and_keep_the_grip() -> None:
    for kind in ("protective_stop", "emergency_stop"):
        world, now_s = grasped(30.0)
        world.command_lift(now_s, 200.0, 100.0)
        before = world.truth(now_s + 1.0)
        world.faults.fail("arm", kind)
        assert getattr(world.arm_state(now_s + 1.0), kind)
        after = world.truth(now_s + 3.0)
        assert 0.0 < after.height_mm - before.height_mm < 3.0
        assert after.in_contact
        assert world.command_lift(now_s + 3.0, 50.0, 50.0) == 0.0
        world.faults.repair("arm", kind)
        assert not world.arm_state(now_s + 4.0).moving
        assert world.command_lift(now_s + 4.0, 50.0, 50.0) == 50.0


def test_a_gripper_in_fault_keeps_its_grip_and_does_nothing() -> None:
    world, now_s = grasped(30.0)
    assert world.gripper_state(now_s).holding
    world.faults.fail("gripper", "fault")
    applied_n = world.gripper_state(now_s).force_n
    assert world.gripper_state(now_s).fault is not None
    assert world.command_hold(now_s, 90.0) == applied_n
    world.command_release(now_s, 85.0)
    assert world.truth(now_s + 2.0).in_contact
    world.faults.repair("gripper")
    assert world.command_hold(now_s + 2.0, 90.0) > 89.0


def test_faults_name_the_alternatives() -> None:
    board = InjectedFaults()
    for device, kinds in KINDS.items():
        for kind in kinds:
            board.fail(device, kind)
        assert board.active(device) == kinds
        board.repair(device)
        assert board.active(device) == frozenset()
    with pytest.raises(InputError, match="there are: left, right, gripper, arm"):
        board.fail("camera", "stall")
    with pytest.raises(InputError, match="there are: corrupt, disconnect, duplicate, frozen, light, sta"):
        board.fail("left", "fault")
    with pytest.raises(InputError, match="there are: left"):
        board.active("camera")


def test_placing_needs_open_jaws_and_an_empty_place() -> None:
    world = make()
    with pytest.raises(InputError, match="no object 'spoon'"):
        world.place(Scenario("spoon"), T0)
    world.command_move(T0, 10.0, 20.0)
    with pytest.raises(CommandRefused, match="release the gripper first"):
        world.place(Scenario("bar"), T0 + 5.0)
    world.command_release(T0 + 5.0, 85.0)
    world.place(Scenario("bar"), T0 + 10.0)
    with pytest.raises(CommandRefused, match="clear it first"):
        world.place(Scenario("bar"), T0 + 10.0)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_values_that_are_not_finite_are_rejected(bad: float) -> None:
    world = make()
    for call in (
        lambda: world.truth(bad),
        lambda: world.command_hold(T0, bad),
        lambda: world.command_move(T0, bad, 20.0),
        lambda: world.command_release(T0, bad),
        lambda: world.command_lift(T0, bad, 20.0),
    ):
        with pytest.raises(InputError, match="must be a"):
            call()


orders = st.one_of(
    st.tuples(st.just("hold"), st.floats(0.0, 250.0)),
    st.tuples(st.just("lift"), st.floats(-200.0, 200.0)),
    st.tuples(st.just("move"), st.floats(0.0, 85.0)),
    st.tuples(st.just("release"), st.floats(0.0, 85.0)),
    st.tuples(st.just("stop"), st.just(0.0)),
)


@settings(max_examples=40, deadline=None)
@given(st.lists(st.tuples(orders, st.floats(0.0, 0.6)), max_size=10), st.integers(0, 1000))
def test_no_sequence_of_commands_breaks_the_world(story: list[tuple[tuple[str, float], float]], seed: int) -> None:
    world = make()
    world.place(scenario("bar", seed), T0)
    now_s, was_dropped = T0, None
    for (name, value), wait_s in story:
        if name == "hold":
            world.command_hold(now_s, value)
        elif name == "lift":
            world.command_lift(now_s, value, 100.0)
        elif name == "move":
            world.command_move(now_s, value, 30.0)
        elif name == "release":
            world.command_release(now_s, value)
        else:
            world.command_stop(now_s)
        now_s += wait_s
        truth = world.truth(now_s)
        numbers = [v for v in (getattr(truth, f) for f in WorldTruth.__slots__) if isinstance(v, float)]
        assert all(math.isfinite(v) for v in numbers)
        assert truth.rotation_deg == pytest.approx(truth.elastic_deg + truth.slip_deg)
        assert 0.0 <= truth.height_mm <= 800.0
        assert was_dropped is None or truth.dropped == was_dropped
        was_dropped = truth.dropped
        for finger in ("left", "right"):
            view = world.view(finger, now_s)
            assert (view.depth_mm > 0) == truth.in_contact


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


SOFT = SoftPad(torsion_n_m_rad=0.3, relaxation_s=0.02)
CREEPING = replace(SOFT, creep=0.5, creep_s=0.4)
FIRM_N = 60.0


def held(scenario: Scenario, lever_mm: float = 40.0, mass_kg: float = 0.2) -> World:
    """A held object without its support, at rest at T0 + 5."""
    world = World(lookup=lambda name: bar(mass_kg=mass_kg, lever_mm=lever_mm, friction=0.8))
    world.place(replace(scenario, object_name="bar", gripper=QUICK), T0)
    world.command_hold(T0, FIRM_N)
    world.take_table(T0 + 2.0)
    return world


def test_a_creeping_pad_twists_further_under_the_same_load_and_does_not_slip() -> None:
    body = GraspedBody.of(bar(mass_kg=0.2, lever_mm=40.0, friction=0.8))

    def twist_deg(gel: SoftPad, seconds: float) -> tuple[float, float]:
        motion = ObjectMotion()
        for _ in range(round(1e3 * seconds)):
            motion = advance(motion, body, gel, ExternalLoad(FIRM_N), 1e-3)
        return math.degrees(motion.twist_rad), math.degrees(motion.rotation_rad - motion.twist_rad)

    elastic_deg, _ = twist_deg(SOFT, 6.0)
    one_s_deg, _ = twist_deg(CREEPING, 0.8)
    crept_deg, slip_deg = twist_deg(CREEPING, 6.0)
    assert crept_deg == pytest.approx(1.5 * elastic_deg, rel=0.02)
    assert elastic_deg < one_s_deg < crept_deg
    assert slip_deg == pytest.approx(0.0, abs=1e-6)


def test_added_mass_and_a_push_of_the_same_weight_twist_the_gel_alike() -> None:
    added, pushed = held(Scenario("bar", gel=SOFT)), held(Scenario("bar", gel=SOFT))
    before = added.truth(T0 + 5.0)
    added.add_mass(T0 + 5.0, 0.1)
    pushed.push(T0 + 5.0, lambda now_s: (0.1 * GRAVITY_M_S2, 0.1 * GRAVITY_M_S2 * 0.04))
    one, other = added.truth(T0 + 8.0), pushed.truth(T0 + 8.0)
    assert one.elastic_deg == pytest.approx(1.5 * before.elastic_deg, rel=0.02)
    assert one.elastic_deg == pytest.approx(other.elastic_deg, rel=0.02)
    assert one.needed_force_n > before.needed_force_n
    pushed.push(T0 + 8.0, None)
    assert pushed.truth(T0 + 10.0).elastic_deg == pytest.approx(before.elastic_deg, rel=0.02)
    added.clear(T0 + 9.0)
    with pytest.raises(CommandRefused, match="no object"):
        added.add_mass(T0 + 9.0, 0.1)
