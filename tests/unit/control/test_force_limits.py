"""The force limit and the steps up to it."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from observations import guard_params

from slipguard.control import force_limits as limits
from slipguard.control.force_limits import ForceRange
from slipguard.sim.gripper_plant import GripperDynamics

ROBOTIQ_85 = (20.0, 235.0)
STEP_N = 215.0 / 255

forces = st.floats(0.0, 300.0)
ranges = st.builds(
    limits.force_range, st.floats(20.0, 300.0), st.sampled_from([ROBOTIQ_85, (10.0, 125.0), (5.0, 5.0), (20.0, 20.0)])
).filter(lambda one: one is not None)


def test_the_force_range_is_the_smaller_of_gripper_and_configuration_on_the_register_grid() -> None:
    within = limits.force_range(130.0, ROBOTIQ_85)
    assert within is not None
    assert within.low_n == 20.0
    assert within.high_n == pytest.approx(20.0 + 130 * STEP_N)
    assert within.high_n <= 130.0 < within.high_n + STEP_N
    whole = limits.force_range(500.0, ROBOTIQ_85)
    assert whole is not None
    assert whole.high_n == pytest.approx(235.0)
    exact = limits.force_range(20.0, ROBOTIQ_85)
    assert exact is not None
    assert exact.high_n == 20.0


def test_below_the_weakest_grip_there_is_no_force_range() -> None:
    assert limits.force_range(19.9, ROBOTIQ_85) is None
    assert limits.force_range(19.9, (10.0, 125.0)) is not None


def test_a_gripper_of_one_force() -> None:
    assert limits.force_range(50.0, (30.0, 30.0)) == ForceRange(30.0, 30.0, 0.0)
    assert ForceRange(30.0, 30.0, 0.0).raised(30.0, 45.0) == 30.0


def test_forces_are_rounded_up_and_kept_within() -> None:
    within = limits.force_range(130.0, ROBOTIQ_85)
    assert within is not None
    assert within.allowed(40.0, 0.0) == pytest.approx(20.0 + 24 * STEP_N)
    assert within.allowed(0.0, 0.0) == 20.0
    assert within.allowed(999.0, 0.0) == within.high_n
    assert within.allowed(40.0, 90.0) == 90.0
    assert within.allowed(40.0, 200.0) == 200.0  # adopted from another program's grip
    assert within.allowed(60.0, 0.0) >= 60.0


@given(forces, forces, ranges)
def test_never_below_the_present_and_never_above_the_force_limit(
    wanted: float, present: float, within: ForceRange
) -> None:
    force_n = within.allowed(wanted, present)
    assert force_n >= present
    assert force_n <= max(within.high_n, present)
    again_n = within.allowed(force_n, force_n)
    assert within.allowed(again_n, again_n) == pytest.approx(again_n)


@given(st.floats(20.0, 235.0), st.floats(1.0, 3.0), ranges)
def test_raising_gains_at_least_one_step_until_the_force_limit(
    present: float, multiple: float, within: ForceRange
) -> None:
    force_n = within.raised(present, present * multiple)
    assert force_n >= min(present + within.step_n, max(within.high_n, present)) - 1e-9


@given(st.floats(20.0, 235.0), st.floats(0.0, 300.0))
def test_a_gripper_that_rounds_up_stays_within_the_force_limit(force_max_n: float, wanted: float) -> None:
    model = GripperDynamics()
    within = limits.force_range(force_max_n, (model.force_min_n, model.force_max_n))
    assert within is not None
    assert model.quantized_force_n(within.allowed(wanted, 0.0)) <= force_max_n + 1e-6


@pytest.mark.parametrize(
    ("values", "force_n"),
    [
        ({}, 100.0),
        ({"force_max_n": 60.0}, 60.0),
        ({"first_force_n": 110.0}, 110.0),
        ({"first_force_n": 40.0, "force_max_n": 99.0}, 99.0),
    ],
)
def test_the_force_without_an_estimate_fits_the_other_forces(values: dict[str, float], force_n: float) -> None:
    assert guard_params(**values).no_estimate_force_n == force_n


@pytest.mark.parametrize(
    ("values", "says"),
    [
        ({"first_force_n": 120.0, "no_estimate_force_n": 100.0}, "first_force_n"),
        ({"no_estimate_force_n": 140.0}, "force_max_n"),
        ({"margin": 1.0}, "margin"),
        ({"margin": "soft"}, "margin"),
        ({"force_max_n": 300.0}, "force_max_n"),
        ({"forse_max_n": 100.0}, "forse_max_n"),
        ({"tighten_delay_s": float("nan")}, "tighten_delay_s"),
        ({"mode": "watch"}, "mode"),
    ],
)
def test_parameters_out_of_range_or_order_are_refused(values: dict[str, object], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        guard_params(**values)
