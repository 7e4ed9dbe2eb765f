"""Friction against its closed forms: pressure shapes, torque limits, critical grips, the flow rule."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from slipguard.errors import InputError
from slipguard.limit_surface import GRAVITY_M_S2, pressure_shape, torque_limit_n_m
from slipguard.sim.friction import STIFFNESS_RADIUS_M, SoftPad, needed_force_n, return_to_surface
from slipguard.sim.sim_object import SimObject

GEL = SoftPad()


def bar(mass_kg: float = 0.35, lever_mm: float = 60.0, friction: float = 0.8) -> SimObject:
    return SimObject("bar", "test", lambda u, v: u, mass_kg, lever_mm, 7.4e-4, friction, press_mm=1.0)


def test_pressure_shape_meets_its_limits() -> None:
    assert pressure_shape(2.0) == pytest.approx(3 * math.pi / 32, rel=1e-14)
    assert pressure_shape(4.0) == pytest.approx(0.3177, abs=5e-5)
    assert pressure_shape(1e5) == pytest.approx(1 / 3, rel=1e-6)
    assert pressure_shape(math.inf) == 1 / 3


@given(st.floats(1.0, 1e4), st.floats(1.01, 10.0))
def test_flatter_pressure_takes_more_torque(k: float, more: float) -> None:
    assert pressure_shape(k) < pressure_shape(k * more) <= 1 / 3 + 1e-6


@pytest.mark.parametrize("k", [0.0, -1.0, math.nan])
def test_pressure_shape_rejects_invalid_exponents(k: float) -> None:
    with pytest.raises(InputError, match="above 0"):
        pressure_shape(k)


def test_torque_limit_is_the_published_formula() -> None:
    expected = 2 * 0.8 * 0.3177 * 4.353e-3 * 20.0**1.2569
    assert torque_limit_n_m(20.0, 0.8, GEL) == pytest.approx(expected, rel=1e-4)
    assert torque_limit_n_m(0.0, 0.8, GEL) == 0.0


def test_a_tangential_load_costs_torque_along_an_ellipse() -> None:
    full = torque_limit_n_m(20.0, 0.8, GEL)
    assert torque_limit_n_m(20.0, 0.8, GEL, tangential_n=0.6 * 16.0) == pytest.approx(0.8 * full, rel=1e-12)
    assert torque_limit_n_m(20.0, 0.8, GEL, tangential_n=16.0) == 0.0
    assert torque_limit_n_m(20.0, 0.8, GEL, tangential_n=-17.0) == 0.0


@pytest.mark.parametrize(
    ("mass_kg", "lever_mm", "friction", "force_n"),
    [
        (0.10, 30, 0.8, 4.5),
        (0.20, 50, 0.8, 11.8),
        (0.35, 60, 0.8, 21.3),
        (0.50, 100, 0.8, 42.4),
        (1.0, 100, 0.4, 128.0),
    ],
)
def test_needed_force_matches_the_table(mass_kg: float, lever_mm: float, friction: float, force_n: float) -> None:
    assert needed_force_n(bar(mass_kg, lever_mm, friction), GEL) == pytest.approx(force_n, rel=0.015)


@given(st.floats(0.01, 3.0), st.floats(0.0, 200.0), st.floats(0.2, 1.5), st.floats(-5.0, 5.0))
def test_needed_force_lies_on_the_limit_surface(
    mass_kg: float, lever_mm: float, friction: float, acceleration: float
) -> None:
    force_n = needed_force_n(bar(mass_kg, lever_mm, friction), GEL, acceleration)
    load_n = mass_kg * (GRAVITY_M_S2 + acceleration) / 2
    share = (load_n / (friction * force_n)) ** 2
    rotation = load_n * lever_mm * 1e-3 / torque_limit_n_m(force_n, friction, GEL)
    assert share + rotation**2 == pytest.approx(1.0, abs=1e-9)


def test_without_a_lever_only_sliding_counts() -> None:
    item = bar(lever_mm=0.0)
    assert needed_force_n(item, GEL) == pytest.approx(item.mass_kg * GRAVITY_M_S2 / 2 / 0.8, rel=1e-9)


def test_in_free_fall_no_force_is_needed() -> None:
    assert needed_force_n(bar(), GEL, acceleration_m_s2=-GRAVITY_M_S2) == 0.0
    assert needed_force_n(bar(), GEL, acceleration_m_s2=-20.0) == 0.0


sizes = st.floats(1e-3, 1e3)
loads = st.floats(-1e4, 1e4)


@given(loads, loads, sizes, sizes, sizes, sizes)
def test_slip_is_normal_to_the_surface_and_dissipates(
    force: float, torque: float, force_max: float, torque_max: float, give: float, rotation_compliance: float
) -> None:
    inside = math.hypot(force / force_max, torque / torque_max)
    got_force, got_torque = return_to_surface((force, torque), (force_max, torque_max), (give, rotation_compliance))
    if inside <= 1.0:
        assert (got_force, got_torque) == (force, torque)
        return
    assert math.hypot(got_force / force_max, got_torque / torque_max) == pytest.approx(1.0, abs=1e-12)
    slip, rotational_slip = give * (force - got_force), rotation_compliance * (torque - got_torque)
    # In units of the half-axes; the answer is good to 1e-12 of them.
    rounding = 1e-11 * (give * force_max**2 + rotation_compliance * torque_max**2) * inside
    assert got_force * slip + got_torque * rotational_slip >= -rounding
    normal = (got_force / force_max, got_torque / torque_max)
    rates = (slip * force_max, rotational_slip * torque_max)
    cross = rates[0] * normal[1] - rates[1] * normal[0]
    assert abs(cross) <= 1e-9 * math.hypot(*rates) + rounding


def test_no_grip_no_friction() -> None:
    assert return_to_surface((3.0, 0.1), (0.0, 0.0), (1.0, 1.0)) == (0.0, 0.0)


def test_a_soft_gel_stiffens_with_its_contact() -> None:
    gel = SoftPad(torsion_n_m_rad=0.16, stiffening=3.0)
    force_at_6_mm = (STIFFNESS_RADIUS_M / gel.radius_m) ** (1 / gel.gamma)
    torsion, shear = gel.stiffness(force_at_6_mm)
    assert torsion == pytest.approx(0.16)
    assert shear == pytest.approx(0.16 / STIFFNESS_RADIUS_M**2)
    bigger, _ = gel.stiffness(force_at_6_mm * 2 ** (1 / gel.gamma))
    assert bigger == pytest.approx(8 * 0.16)
    assert SoftPad().stiffness(5.0) == SoftPad().stiffness(50.0)
