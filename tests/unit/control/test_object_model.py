"""With friction and mass given, the controller computes the force that it otherwise finds by slip."""

from __future__ import annotations

import math
import re
from typing import Any

import numpy as np
import pytest
from controller_steps import NOW_S, Play, seen_in, state_in
from observations import arm, fused, gripper, guard_params
from records import changed

from slipguard.control import force_limits as limits
from slipguard.control.control_step import step
from slipguard.control.messages import RequestKind, StepOutput
from slipguard.control.params import MODEL_RESERVE, GuardParams
from slipguard.control.phases import AGAIN_TIMES
from slipguard.control.state import Phase
from slipguard.limit_surface import GRAVITY_M_S2, Pad, force_needed_n
from slipguard.sim.catalogue import find_object, object_names
from slipguard.sim.contact_label import label
from slipguard.sim.friction import SoftPad, needed_force_n
from slipguard.sim.gel_camera import GelCamera
from slipguard.sim.gel_view import GelView
from slipguard.sim.sensor_unit import SensorUnit


def test_the_force_is_the_worlds_with_a_reserve() -> None:
    item = find_object("wrench")
    params = guard_params(friction=item.friction, mass_kg=item.mass_kg, lever_mm=item.com_offset_mm)
    needed_n = MODEL_RESERVE * needed_force_n(item, SoftPad())
    assert params.modelled_n() == pytest.approx(needed_n, rel=1e-9)
    assert limits.first_n(params) == params.modelled_n()


def test_without_friction_and_mass_the_first_grip_is_the_configured_one() -> None:
    params = GuardParams()
    assert params.modelled_n() is None
    assert limits.first_n(params) == 40.0


def test_the_first_grip_is_no_weaker_than_configured() -> None:
    assert limits.first_n(guard_params(friction=1.0, mass_kg=0.1)) == 40.0


def test_a_grasp_uses_it_and_so_does_the_first_step() -> None:
    params = guard_params(friction=0.6, mass_kg=0.6, lever_mm=100.0)
    play = Play(params)
    command = play.step(RequestKind.GRASP)
    assert command.hold_force_n == pytest.approx(params.modelled_n() or 0.0, abs=0.85)
    gentle = Play(params)
    gentle.step(RequestKind.GRASP, force_n=25.0)
    gentle.step()
    gentle.view = changed(
        gentle.view, left_contact=True, right_contact=True, rotation_deg=0.0, sigma_deg=0.1, rate_deg_s=0.0
    )
    gentle.view = changed(gentle.view, fingers=("left", "right"), shift_mm=0.0, declined=None, contact_radius_mm=8.0)
    gentle.steps(0.6)
    gentle.here = arm()
    needed_n = params.modelled_n(limits.seen_pad(8.0, gentle.grasp.grip.target_n)) or 0.0
    assert (gentle.slips(3.0, 10.0).hold_force_n or 0.0) >= needed_n


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


GRASPS = [
    (radius_mm, friction, mass_kg, lever_mm)
    for radius_mm in (2.5, 3.0, 3.5, 4.0, 5.0, 6.5, 8.0)
    for friction, mass_kg, lever_mm in (
        (0.3, 0.2, 30.0), (0.4, 1.0, 0.0), (0.5, 0.35, 40.0), (0.6, 0.5, 50.0), (0.8, 0.6, 20.0), (1.0, 0.3, 90.0),
    )
]  # fmt: skip
"""Radius of the contact at 40 N, and the object."""


def image_radius_mm(radius_mm: float, slopes: float) -> float:
    """The radius of a disk with the area that the image (13 x 17.3 mm) shows of a contact and its slopes."""
    radius_mm, half_mm = radius_mm * slopes, 6.5
    if radius_mm <= half_mm:
        return radius_mm
    share = half_mm / radius_mm
    area_mm2 = 2.0 * radius_mm**2 * (share * math.sqrt(1.0 - share**2) + math.asin(share))
    return math.sqrt(min(area_mm2, 13.0 * 17.3) / math.pi)


@pytest.mark.parametrize("slopes", [1.0, 1.25])
@pytest.mark.parametrize(("radius_mm", "friction", "mass_kg", "lever_mm"), GRASPS)
def test_the_grip_suits_the_contact_that_is_seen(
    radius_mm: float, friction: float, mass_kg: float, lever_mm: float, slopes: float
) -> None:
    """Before the lift it is at least what the object needs on its contact, and at most twice that."""
    play = Play(
        guard_params(friction=friction, mass_kg=mass_kg, lever_mm=lever_mm, first_force_n=1.0, force_max_n=235.0)
    )
    true_pad = Pad(radius_m=1e-3 * radius_mm / 40.0**0.2569)
    needed_n = force_needed_n(0.5 * mass_kg * GRAVITY_M_S2, 1e-3 * lever_mm, friction, true_pad)
    play.step(RequestKind.GRASP)
    for _ in range(100):
        seen_mm = image_radius_mm(1e3 * true_pad.contact_radius_m(play.jaws.force_n), slopes)
        play.view = fused(contact_radius_mm=seen_mm)
        play.step()
        if play.grasp.phase is Phase.HOLDING:
            break
    assert play.grasp.phase is Phase.HOLDING
    assert needed_n <= play.grasp.grip.target_n <= max(2.0 * needed_n, 20.85)


def test_a_firmer_grip_for_the_contact_is_reported_and_takes_a_new_reference() -> None:
    play = Play(guard_params(friction=0.6, mass_kg=0.6, lever_mm=60.0))
    play.step(RequestKind.GRASP)
    play.step()
    play.view = fused(contact_radius_mm=5.0)
    firmer = play.step()
    assert firmer.new_reference
    assert play.grasp.phase is Phase.REFERENCE
    assert re.fullmatch(r"a contact of 5.0 mm radius needs \d+ N: gripping with \d+ N", firmer.text or "")
    play.steps(0.1)
    assert play.grasp.phase is Phase.HOLDING


def test_a_grip_requested_to_be_weaker_stays() -> None:
    play = Play(guard_params(friction=0.6, mass_kg=0.6, lever_mm=60.0))
    play.step(RequestKind.GRASP, force_n=25.0)
    play.step()
    play.view = fused(contact_radius_mm=5.0)
    play.steps(0.1)
    assert play.grasp.phase is Phase.HOLDING
    assert play.grasp.grip.target_n < 26.0


def test_a_contact_that_no_camera_shows_counts_as_small() -> None:
    params = guard_params(friction=0.6, mass_kg=0.6, lever_mm=60.0, force_max_n=235.0)
    forces_n = []
    for radius_mm in (None, limits.UNSEEN_MM / limits.SEEN_SHARE, 6.0):
        play = Play(params)
        play.step(RequestKind.GRASP)
        play.step()
        play.view = fused(contact_radius_mm=radius_mm)
        play.steps(0.02)
        forces_n.append(play.grasp.grip.target_n)
    assert forces_n[0] == forces_n[1] > forces_n[2]


def test_most_contacts_hold_the_torque_that_their_image_promises() -> None:
    camera, shares = GelCamera(SensorUnit()), []
    for name in object_names("test"):
        truth = camera.draw_with_truth(GelView(name, depth_mm=0.8))
        rows, columns = np.nonzero(truth.contact)
        # a disk's mean distance from its middle is 2/3 of its radius
        radius_px = 1.5 * np.hypot(columns - columns.mean(), rows - rows.mean()).mean()
        shares.append(radius_px / math.sqrt(label(truth).sum() / math.pi))
    assert np.percentile(shares, 10) >= limits.SEEN_SHARE


def reference_step(**changes: Any) -> StepOutput:
    """One step in REFERENCE with a contact that needs more than the present 40 N."""
    params = guard_params(friction=0.6, mass_kg=0.4, lever_mm=60.0)
    view = changed(seen_in(Phase.REFERENCE), fused=fused(at_s=NOW_S, contact_radius_mm=5.0))
    return step(state_in(Phase.REFERENCE), changed(view, **changes), params)[1]


def test_jaws_that_still_move_show_a_contact_at_an_unknown_force() -> None:
    assert reference_step().hold_force_n is not None
    assert reference_step(gripper=gripper(moving=True, at_s=NOW_S)).hold_force_n is None
    assert reference_step(gripper=gripper(at_s=NOW_S - 0.6)).hold_force_n is None


def test_no_force_is_added_for_a_contact_while_a_person_may_be_near() -> None:
    assert reference_step(arm=arm(protective=True, at_s=NOW_S)).hold_force_n is None


def test_a_contact_seen_again_raises_the_grip_only_if_it_needs_clearly_more() -> None:
    """The noise of the seen area must not add a step each time."""
    params = guard_params(friction=0.6, mass_kg=0.4, lever_mm=60.0)
    view = changed(seen_in(Phase.REFERENCE), fused=fused(at_s=NOW_S, contact_radius_mm=5.0))
    for times, firmer in ((AGAIN_TIMES - 0.02, False), (AGAIN_TIMES + 0.02, True)):
        present_n = next(
            n for n in np.arange(130.0, 40.0, -0.1) if (params.modelled_n(limits.seen_pad(5.0, n)) or 0.0) > times * n
        )
        output = step(state_in(Phase.REFERENCE, target_n=float(present_n)), view, params)[1]
        assert output.new_reference is firmer
