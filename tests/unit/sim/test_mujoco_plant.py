"""The MuJoCo plant behind the interface of `object_motion.advance`, if MuJoCo is installed."""

from __future__ import annotations

import math
import sys
from dataclasses import replace

import pytest
from world_scene import bar

from slipguard.errors import InputError
from slipguard.sim.friction import SoftPad, needed_force_n
from slipguard.sim.mujoco_plant import MujocoPlant
from slipguard.sim.object_motion import ExternalLoad, GraspedBody, ObjectMotion, advance

SOFT = SoftPad(torsion_n_m_rad=0.25, stiffening=3.0, relaxation_s=0.02)
CREEPING = replace(SOFT, creep=0.5, creep_s=0.4)
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
@pytest.mark.parametrize("gel", [SOFT, CREEPING])
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


@pytest.mark.extras("mujoco")
def test_added_mass_and_a_new_grasp_change_the_model() -> None:
    body = GraspedBody.of(bar(mass_kg=0.2, lever_mm=40.0, friction=0.8))
    plant, load = MujocoPlant(), ExternalLoad(60.0)
    motion = ObjectMotion()
    for _ in range(400):
        motion = plant(motion, body, SOFT, load, STEP_S)
    first_deg = math.degrees(motion.twist_rad)
    heavier = replace(body, mass_kg=0.4, inertia_kg_m2=2.0 * body.inertia_kg_m2)
    for _ in range(400):
        motion = plant(motion, heavier, SOFT, load, STEP_S)
    assert math.degrees(motion.twist_rad) == pytest.approx(2.0 * first_deg, rel=0.05)
    assert plant(ObjectMotion(), body, SOFT, load, STEP_S).twist_rad == pytest.approx(0.0, abs=1e-3)


def test_without_mujoco_it_says_how_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(InputError, match=r"slipguard\[mujoco\]"):
        MujocoPlant()
