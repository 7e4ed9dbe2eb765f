"""With friction and mass given, the controller computes the force that it otherwise finds by slip."""

from __future__ import annotations

import pytest
from controller_steps import Play
from observations import arm, guard_params
from records import changed

from slipguard.control import force_limits as limits
from slipguard.control.messages import RequestKind
from slipguard.control.params import MODEL_RESERVE, GuardParams
from slipguard.sim.catalogue import find_object
from slipguard.sim.friction import SoftPad, needed_force_n


def test_the_force_is_the_worlds_with_a_reserve() -> None:
    item = find_object("wrench")
    params = guard_params(friction=item.friction, mass_kg=item.mass_kg, lever_mm=item.com_offset_mm)
    needed_n = MODEL_RESERVE * needed_force_n(item, SoftPad())
    assert params.modelled_n == pytest.approx(needed_n, rel=1e-9)
    assert limits.first_n(params) == params.modelled_n


def test_without_friction_and_mass_the_first_grip_is_the_configured_one() -> None:
    params = GuardParams()
    assert params.modelled_n is None
    assert limits.first_n(params) == 40.0


def test_the_first_grip_is_no_weaker_than_configured() -> None:
    assert limits.first_n(guard_params(friction=1.0, mass_kg=0.1)) == 40.0


def test_a_grasp_uses_it_and_so_does_the_first_step() -> None:
    params = guard_params(friction=0.6, mass_kg=0.6, lever_mm=100.0)
    play = Play(params)
    command = play.step(RequestKind.GRASP)
    assert command.hold_force_n == pytest.approx(params.modelled_n or 0.0, abs=0.85)
    gentle = Play(params)
    gentle.step(RequestKind.GRASP, force_n=25.0)
    gentle.step()
    gentle.view = changed(
        gentle.view, left_contact=True, right_contact=True, rotation_deg=0.0, sigma_deg=0.1, rate_deg_s=0.0
    )
    gentle.view = changed(gentle.view, fingers=("left", "right"), shift_mm=0.0, declined=None)
    gentle.steps(0.6)
    gentle.here = arm()
    assert gentle.slips(3.0, 10.0).hold_force_n == pytest.approx(params.modelled_n or 0.0, abs=0.85)


@pytest.mark.parametrize(
    ("values", "says"),
    [
        ({"friction": 0.5}, "go together"),
        ({"mass_kg": 0.5}, "go together"),
        ({"friction": 0.4, "mass_kg": 2.0, "lever_mm": 100.0}, "force_max_n"),
    ],
)
def test_half_a_model_or_one_above_the_force_limit_is_refused(values: dict[str, float], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        guard_params(**values)
