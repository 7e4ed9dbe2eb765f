"""Lift profiles: exact times and heights, no jumps, and stops with a braking distance."""

from __future__ import annotations

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from slipguard.sim.arm_plant import ArmModel, ArmPlant, order_lift, order_stop, pose, report

MODEL = ArmModel(acceleration_mm_s2=1200.0, stop_mm_s2=2500.0)
AT_REST = ArmPlant()


def continuous(plant: ArmPlant, tolerance_mm: float = 1e-6) -> bool:
    """Return whether height and speed of the plan have no jumps."""
    for segment, following in pairwise(plant.segments):
        t = following.start_s - segment.start_s
        height = segment.height_mm + t * (segment.speed_mm_s + 0.5 * segment.acceleration_mm_s2 * t)
        speed = segment.speed_mm_s + t * segment.acceleration_mm_s2
        if abs(height - following.height_mm) > tolerance_mm or abs(speed - following.speed_mm_s) > tolerance_mm:
            return False
    return True


def end_s(plant: ArmPlant) -> float:
    return plant.segments[-1].start_s


def test_a_lift_is_a_trapezoid() -> None:
    plant, speed = order_lift(AT_REST, MODEL, 10.0, 100.0, 60.0)
    assert speed == 60.0
    assert end_s(plant) - 10.0 == pytest.approx(100.0 / 60.0 + 60.0 / 1200.0)
    assert pose(plant, 10.025).acceleration_mm_s2 == 1200.0
    assert pose(plant, 11.0).speed_mm_s == pytest.approx(60.0)
    assert pose(plant, 11.0).acceleration_mm_s2 == 0.0
    assert pose(plant, end_s(plant) - 0.01).acceleration_mm_s2 == -1200.0
    state = report(plant, 20.0)
    assert (state.height_mm, state.speed_mm_s, state.moving) == (100.0, 0.0, False)


def test_speed_is_held_to_the_arms_limits() -> None:
    assert order_lift(AT_REST, MODEL, 0.0, 10.0, 1000.0)[1] == 250.0
    assert order_lift(AT_REST, MODEL, 0.0, 10.0, 0.0)[1] == 1.0


def test_a_stop_takes_its_way() -> None:
    plant, _ = order_lift(AT_REST, MODEL, 0.0, 400.0, 250.0)
    before = pose(plant, 1.0)
    stopped = order_stop(plant, MODEL, 1.0)
    assert end_s(stopped) - 1.0 == pytest.approx(0.1)
    assert pose(stopped, 9.0).height_mm - before.height_mm == pytest.approx(250.0**2 / 2 / 2500.0)
    assert pose(stopped, 1.05).acceleration_mm_s2 == -2500.0


moves = st.tuples(st.floats(-300.0, 300.0), st.floats(0.0, 300.0), st.floats(0.0, 2.0), st.booleans())


@given(st.lists(moves, min_size=1, max_size=6))
def test_no_sequence_of_orders_makes_it_jump(orders: list[tuple[float, float, float, bool]]) -> None:
    plant, now_s = AT_REST, 0.0
    for way_mm, speed, wait_s, stop in orders:
        before = pose(plant, now_s)
        if stop:
            plant = order_stop(plant, MODEL, now_s)
        else:
            plant, _ = order_lift(plant, MODEL, now_s, way_mm, speed)
            goal = min(max(before.height_mm + way_mm, 0.0), 800.0)
            assert pose(plant, now_s + 1e4).height_mm == pytest.approx(goal)
        after = pose(plant, now_s)
        assert after.height_mm == pytest.approx(before.height_mm, abs=1e-6)
        assert after.speed_mm_s == pytest.approx(before.speed_mm_s, abs=1e-6)
        assert continuous(plant)
        assert all(
            abs(leg.acceleration_mm_s2) <= 2500.0 and abs(leg.speed_mm_s) <= 250.0 + 1e-6 for leg in plant.segments
        )
        now_s += wait_s
