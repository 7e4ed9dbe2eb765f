"""Loads that arrive while an object is held, creeping pads, and a wrist that rotates about the grasp axis."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from world_scene import QUICK, T0, bar

from slipguard.errors import CommandRefused
from slipguard.limit_surface import GRAVITY_M_S2
from slipguard.sim.friction import SoftPad
from slipguard.sim.object_motion import ExternalLoad, GraspedBody, ObjectMotion, advance
from slipguard.sim.scenario import Scenario
from slipguard.sim.world import World

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


@pytest.mark.parametrize(("wrist_deg", "right", "up"), [(0.0, 0.0, -1.0), (90.0, 1.0, 0.0), (180.0, 0.0, 1.0)])
def test_a_slide_goes_along_gravity_in_both_images(wrist_deg: float, right: float, up: float) -> None:
    world = held(Scenario("bar", wrist_deg=wrist_deg), lever_mm=0.0, mass_kg=5.0)
    world.add_mass(T0 + 3.0, 6.0)
    truth, left, other = world.truth(T0 + 3.1), world.view("left", T0 + 3.1), world.view("right", T0 + 3.1)
    assert 0.5 < truth.slip_mm < 12.0
    assert truth.dropped is None
    assert (left.x_mm, left.y_mm) == (
        pytest.approx(right * truth.slip_mm, abs=1e-9),
        pytest.approx(up * truth.slip_mm, abs=1e-9),
    )
    assert (other.x_mm, other.y_mm) == (pytest.approx(-left.x_mm, abs=1e-9), left.y_mm)


def test_a_lever_off_the_horizontal_rotates_less() -> None:
    level, steep = (held(Scenario("bar", gel=SOFT, lever_deg=deg)).truth(T0 + 6.0) for deg in (0.0, 45.0))
    assert steep.elastic_deg == pytest.approx(math.cos(math.radians(45.0)) * level.elastic_deg, rel=0.15)
