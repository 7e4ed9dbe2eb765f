"""The object's motion and friction against closed forms; dry friction unless a test says otherwise."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from world_scene import bar

from slipguard.errors import InputError
from slipguard.limit_surface import GRAVITY_M_S2, torque_limit_n_m
from slipguard.sim.friction import SoftPad, needed_force_n, return_to_surface
from slipguard.sim.mujoco_plant import MujocoPlant
from slipguard.sim.object_motion import ExternalLoad, GraspedBody, ObjectMotion, advance

RIGID = SoftPad(torsion_n_m_rad=5e4, relaxation_s=1e-3, viscous_n_m_s=0.0, viscous_n_s_m=0.0)
STIFF = SoftPad(torsion_n_m_rad=50.0, relaxation_s=5e-3, viscous_n_m_s=0.0, viscous_n_s_m=0.0)
SOFT = SoftPad(torsion_n_m_rad=0.3, relaxation_s=0.03)


HINGED = GraspedBody.of(bar(), translates=False)
FREE = GraspedBody.of(bar())


def run(
    body: GraspedBody,
    gel: SoftPad,
    seconds: float,
    load: Callable[[float], ExternalLoad],
    start: ObjectMotion | None = None,
    step_s: float = 1e-4,
) -> list[ObjectMotion]:
    motions = [start or ObjectMotion()]
    for i in range(round(seconds / step_s)):
        motions.append(advance(motions[-1], body, gel, load(i * step_s), step_s))
    return motions


def tau_c(force_n: float, body: GraspedBody = HINGED) -> float:
    return 2 * torque_limit_n_m(force_n, body.friction, RIGID)


def test_a_torque_below_the_limit_winds_up_and_does_not_drift() -> None:
    torque = 0.9 * tau_c(20.0)
    motions = run(HINGED, STIFF, 20.0, lambda t: ExternalLoad(30.0, torque_n_m=torque), step_s=1e-3)
    assert motions[-1].rotation_rad == pytest.approx(torque / (2 * 50.0), rel=1e-9)
    assert all(abs(m.rotation_rad - m.twist_rad) < 1e-12 and not m.slipping for m in motions)


def test_exactly_at_the_limit_it_sticks_just_above_it_runs_away() -> None:
    limit = tau_c(20.0)
    wound = ObjectMotion(rotation_rad=limit / 100.0, twist_rad=limit / 100.0, twist_n_m=limit)

    def slipped(factor: float) -> float:
        end = run(HINGED, STIFF, 2.0, lambda t: ExternalLoad(20.0, torque_n_m=factor * limit), wound, step_s=1e-3)[-1]
        return end.rotation_rad - end.twist_rad

    assert abs(slipped(1.0)) < 1e-9
    assert slipped(1.01) > math.radians(10.0)


def test_constant_torque_above_the_limit_accelerates_evenly() -> None:
    surplus, seconds = 0.05, 0.2
    motions = run(HINGED, RIGID, seconds, lambda t: ExternalLoad(8.0, torque_n_m=tau_c(8.0) + surplus))
    alpha = surplus / HINGED.inertia_kg_m2
    assert motions[-1].rotation_rad == pytest.approx(0.5 * alpha * seconds**2, rel=3e-3)
    assert motions[-1].rate_rad_s == pytest.approx(alpha * seconds, rel=3e-3)


def test_without_grip_it_swings_like_a_pendulum() -> None:
    motions = run(HINGED, RIGID, 3.0, lambda t: ExternalLoad(0.0), ObjectMotion(rotation_rad=math.pi / 2 - 0.05))
    swing = [m.rotation_rad - math.pi / 2 for m in motions]
    crossings = [i for i in range(1, len(swing)) if swing[i - 1] < 0 <= swing[i]]
    period = (crossings[-1] - crossings[0]) * 1e-4 / (len(crossings) - 1)
    exact = 2 * math.pi * math.sqrt(HINGED.inertia_kg_m2 / (0.35 * GRAVITY_M_S2 * 0.06))
    assert period == pytest.approx(exact, rel=1e-3)


def test_tightening_arrests_after_the_exact_angle_and_time() -> None:
    torque, rate = 0.17, 1.5
    motions = run(HINGED, RIGID, 0.4, lambda t: ExternalLoad(40.0, torque_n_m=torque), ObjectMotion(rate_rad_s=rate))
    deceleration = (tau_c(40.0) - torque) / HINGED.inertia_kg_m2
    assert motions[-1].rotation_rad == pytest.approx(rate**2 / (2 * deceleration), rel=2e-2)
    stopped = next(i for i, m in enumerate(motions) if m.rate_rad_s <= 0.0) * 1e-4
    assert stopped == pytest.approx(rate / deceleration, rel=3e-2)


def test_halving_the_step_halves_the_error() -> None:
    def angle(step_s: float) -> float:
        return run(FREE, SOFT, 0.2, lambda t: ExternalLoad(15.0), step_s=step_s)[-1].rotation_rad

    exact = angle(1e-5)
    errors = [abs(angle(step_s) - exact) for step_s in (1e-3, 5e-4, 2.5e-4)]
    assert errors[0] / exact < 0.01
    assert errors[0] / errors[1] == pytest.approx(2.0, abs=0.2)
    assert errors[1] / errors[2] == pytest.approx(2.0, abs=0.2)


@pytest.mark.parametrize("step_s", [2e-3, 1e-3, 2e-4])
def test_the_critical_grip_is_the_closed_form_for_any_step(step_s: float) -> None:
    needed_n = needed_force_n(bar(), STIFF)

    def slips(force_n: float) -> bool:
        def eased(t: float) -> ExternalLoad:  # the weight comes on slowly: no overshoot
            return ExternalLoad(force_n, acceleration_m_s2=-GRAVITY_M_S2 * max(0.0, 1.0 - t))

        end = run(FREE, STIFF, 1.5, eased, step_s=step_s)[-1]
        return end.rotation_rad - end.twist_rad > 1e-4

    # The lever levels off by less than 1 mrad of wind-up: one part in a million.
    assert slips(needed_n * 0.999)
    assert not slips(needed_n * 1.001)


def test_wind_up_is_large_on_a_soft_gel_and_comes_back() -> None:
    torque = 0.1

    def pulse(t: float) -> ExternalLoad:
        return ExternalLoad(40.0, torque_n_m=torque if t < 2.0 else 0.0)

    motions = run(HINGED, SOFT, 4.0, pulse, step_s=1e-3)
    assert motions[1999].rotation_rad == pytest.approx(torque / (2 * 0.3), rel=1e-3)
    assert abs(motions[-1].rotation_rad) < math.radians(0.01)


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.tuples(st.floats(0.0, 300.0), st.floats(-20.0, 20.0), st.floats(-0.2, 0.2)), min_size=1, max_size=12),
    st.sampled_from([RIGID, STIFF, SOFT, SoftPad(torsion_n_m_rad=0.1, stiffening=3.0)]),
    st.floats(0.01, 3.0),
    st.floats(0.0, 200.0),
    st.booleans(),
)
def test_no_sequence_of_grips_breaks_it(
    pieces: list[tuple[float, float, float]], gel: SoftPad, mass_kg: float, lever_mm: float, table: bool
) -> None:
    body, motion, rise = GraspedBody.of(bar(mass_kg, lever_mm)), ObjectMotion(), 0.0
    for force_n, acceleration, rise_m_s in pieces:
        for _ in range(30):
            rise = max(rise + 1e-3 * rise_m_s, 0.0)
            load = ExternalLoad(force_n, acceleration, rise if table else None, rise_m_s)
            motion = advance(motion, body, gel, load, 1e-3)
            assert all(
                math.isfinite(x) for x in (motion.rotation_rad, motion.rate_rad_s, motion.slip_m, motion.slip_m_s)
            )
            # It only ever gets energy from gravity, the table and the acceleration: speeds stay those of a fall.
            assert abs(motion.slip_m_s) < 40.0
            assert abs(motion.twist_n_m) < 1e3


@pytest.mark.parametrize(
    ("ratio", "tightened", "mujoco_deg"),
    [
        (0.80, 0.80, 41.5),
        (0.90, 0.90, 21.9),
        (0.97, 0.97, 6.83),
        (1.03, 1.03, 0.0),
        (1.50, 1.50, 0.0),
        (0.80, 1.60, 13.28),
    ],
)
def test_it_rotates_as_far_as_in_mujoco(ratio: float, tightened: float, mujoco_deg: float) -> None:
    """Recorded from MuJoCo 4.0.0: elliptic cone, condim 4, impratio 10, 20 noslip iterations, tightened at 0.12 s."""
    needed_n = needed_force_n(bar(), RIGID)
    seconds = 0.4 if tightened != ratio else 0.25
    end = run(FREE, RIGID, seconds, lambda t: ExternalLoad(needed_n * (ratio if t < 0.12 else tightened)))[-1]
    assert math.degrees(end.rotation_rad) == pytest.approx(mujoco_deg, abs=0.5)


GEL = SoftPad()


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


COMPLIANT = SoftPad(torsion_n_m_rad=0.25, stiffening=3.0, relaxation_s=0.02)
CREEPING = replace(COMPLIANT, creep=0.5, creep_s=0.4)
STEP_S = 2e-3


def lifted(plant: MujocoPlant | None, body: GraspedBody, gel: SoftPad, force_n: float) -> ObjectMotion:
    """Grip with this force on the table, then lift for 1.4 s."""
    motion = ObjectMotion()
    for k in range(900):
        now_s = STEP_S * k
        up_s = max(now_s - 0.4, 0.0)
        load = ExternalLoad(force_n * min(now_s / 0.2, 1.0), rise_m=0.05 * up_s, rise_m_s=0.05 * (up_s > 0.0))
        motion = (plant or advance)(motion, body, gel, load, STEP_S)
    return motion


@pytest.mark.extras("mujoco")
@pytest.mark.parametrize("gel", [COMPLIANT, CREEPING])
@pytest.mark.parametrize(("difference", "apart_deg"), [(0.0, 0.3), (0.3, 1.5)])
def test_the_needed_force_holds_and_less_slips_as_in_our_plant(
    gel: SoftPad, difference: float, apart_deg: float
) -> None:
    """Fingers of different friction hold what two of the mean one hold, once the weaker one has slipped a little."""
    item = bar(mass_kg=0.35, lever_mm=60.0, friction=0.8)
    body = replace(GraspedBody.of(item), friction_difference=difference)
    needed_n = needed_force_n(item, gel)
    ours, theirs = (lifted(plant, body, gel, 1.15 * needed_n) for plant in (None, MujocoPlant()))
    assert math.degrees(theirs.rotation_rad) == pytest.approx(math.degrees(ours.rotation_rad), abs=apart_deg)
    assert math.degrees(theirs.rotation_rad - theirs.twist_rad) < apart_deg
    slipped = lifted(MujocoPlant(), body, gel, 0.8 * needed_n)
    assert math.degrees(slipped.rotation_rad - slipped.twist_rad) > 10.0
    assert slipped.load_n == pytest.approx(0.35 * 9.80665, rel=0.1)


def test_without_mujoco_it_says_how_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(InputError, match=r"slipguard\[mujoco\]"):
        MujocoPlant()
