"""The 2F-85 as a plant: late, quantized, self-locking."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slipguard.sim.gripper_plant import (
    UNLOAD_N_S,
    GripperDynamics,
    GripperPlant,
    advance,
    order_hold,
    order_release,
    report,
)

MODEL = GripperDynamics(dead_time_s=0.04, ramp_n_s=200.0, speed_mm_s=100.0)
OPEN = GripperPlant()
STEP_S = 1e-3
HELD_N = MODEL.quantized_force_n(40.0)
HELD = GripperPlant(width_mm=30.0, force_n=HELD_N, applied_n=HELD_N, goal_mm=0.0, goal_n=HELD_N, holding=True)


def run(
    plant: GripperPlant, start_s: float, seconds: float, object_mm: float | None = 30.0, model: GripperDynamics = MODEL
) -> list[GripperPlant]:
    plants = [plant]
    for i in range(1, round(seconds / STEP_S) + 1):
        plants.append(advance(plants[-1], model, start_s + i * STEP_S, STEP_S, object_mm))
    return plants


def test_closing_waits_for_line_and_motor_then_stops_on_the_object() -> None:
    plant, applied_n = order_hold(OPEN, MODEL, 0.0, 40.0)
    assert 40.0 <= applied_n < 40.9
    plants = run(plant, 0.0, 1.5)
    started = next(i for i, p in enumerate(plants) if p.width_mm < 85.0) * STEP_S
    assert started == pytest.approx(0.016 + 0.04, abs=2e-3)
    touched = next(i for i, p in enumerate(plants) if p.force_n > 0.0) * STEP_S
    assert touched - started == pytest.approx(55.0 / 100.0, abs=3e-3)
    end = plants[-1]
    assert end.width_mm == 30.0
    assert end.force_n == pytest.approx(applied_n)
    full = next(i for i, p in enumerate(plants) if p.holding) * STEP_S
    assert full - touched == pytest.approx(applied_n / 200.0, abs=3e-3)
    state = report(end, 1.5)
    assert (state.holding, state.moving, state.closed_on_nothing, state.fault) == (True, False, False, None)
    assert report(plant, 0.0).moving


def test_tightening_at_rest_costs_stop_and_go() -> None:
    plant, _ = order_hold(HELD, MODEL, 0.0, 60.0)
    plants = run(plant, 0.0, 0.5)
    rising = next(i for i, p in enumerate(plants) if p.force_n > HELD_N) * STEP_S
    assert rising == pytest.approx(2 * 0.016 + 0.04, abs=2e-3)
    assert all(p.holding and report(p, 0.0).holding for p in plants)


def test_the_true_force_has_the_gain_error_which_is_not_reported() -> None:
    model = replace(MODEL, gain=1.1)
    plant, applied_n = order_hold(OPEN, model, 0.0, 40.0)
    end = run(plant, 0.0, 1.5, model=model)[-1]
    assert end.force_n == pytest.approx(1.1 * applied_n)
    assert report(end, 0.0).force_n == applied_n


@settings(max_examples=50, deadline=None)
@given(st.lists(st.tuples(st.floats(0.0, 300.0), st.integers(0, 80)), max_size=8), st.floats(0.9, 1.1))
def test_force_never_falls_until_the_fingers_open(orders: list[tuple[float, int]], gain: float) -> None:
    model, plant, now_s = replace(MODEL, gain=gain), HELD, 0.0
    highest_n = HELD_N
    for force_n, steps in orders:
        plant, applied_n = order_hold(plant, model, now_s, force_n)
        highest_n = max(highest_n, applied_n)
        assert applied_n == highest_n
        for _ in range(steps):
            before, now_s = plant, now_s + STEP_S
            plant = advance(plant, model, now_s, STEP_S, 30.0)
            assert plant.force_n >= before.force_n
            assert plant.width_mm == 30.0
    assert plant.force_n <= max(highest_n * gain, HELD_N) + 1e-9


def test_release_unloads_then_opens_and_forgets_the_force() -> None:
    plant = order_release(HELD, MODEL, 0.0, 60.0)
    plants = run(plant, 0.0, 1.0)
    unloaded = next(i for i, p in enumerate(plants) if p.force_n == 0.0) * STEP_S
    assert unloaded == pytest.approx(2 * 0.016 + 0.04 + HELD_N / UNLOAD_N_S, abs=3e-3)
    end = plants[-1]
    assert end.width_mm == pytest.approx(60.0, abs=MODEL.width_step_mm / 2)
    assert not end.holding
    assert end.applied_n == 0.0
    _, applied_n = order_hold(end, MODEL, 1.0, 25.0)
    assert applied_n < 26.0


def test_closing_on_nothing_ends_at_the_end_stop() -> None:
    plant, _ = order_hold(OPEN, MODEL, 0.0, 30.0)
    end = run(plant, 0.0, 1.5, object_mm=None)[-1]
    assert end.width_mm == 0.0
    assert end.closed_on_nothing
    assert not end.holding
    assert end.force_n == 0.0
    reopened = run(order_release(end, MODEL, 2.0, 85.0), 2.0, 1.5, object_mm=None)[-1]
    assert not reopened.closed_on_nothing
