"""Single runs of the grip bench: baselines, the clairvoyant bound, and a MuJoCo plant behind the same scenarios."""

from __future__ import annotations

from dataclasses import replace

import pytest

from slipguard.bench.grip.disturbances import DISTURBANCES, LOWERING
from slipguard.bench.grip.lift_course import DROPPED_DEG
from slipguard.bench.grip.lift_run import constant_n, run_lift
from slipguard.bench.grip.scenarios import GripScenario, draw, scenarios

SCENARIOS = scenarios(90, 0)


def weak(event: str) -> GripScenario:
    """A scenario with a first grip that is too weak, at an actuator of average speed."""
    found = next(one for one in SCENARIOS if one.event == event and one.weak and one.motion == "rotation")
    gripper = replace(found.pose.gripper, ramp_n_s=200.0, dead_time_s=0.04, transaction_s=0.01)
    return replace(found, pose=replace(found.pose, gripper=gripper))


def test_a_weak_grip_slips_and_the_needed_force_from_the_start_does_not() -> None:
    one = weak("lift")
    assert run_lift(one, "no guard").slip_deg > 5.0
    firm = replace(one, first_n=1.05 * one.needed_n / one.pose.gripper.gain)
    held = run_lift(firm, "no guard")
    assert (held.slip_deg, held.dropped, held.tightenings) == (pytest.approx(0.0, abs=0.05), None, 0)


@pytest.mark.parametrize("event", ["lift", "support gone", "mass added", "contact", "acceleration"])
def test_every_event_needs_more_than_just_below_the_stated_force(event: str) -> None:
    """Below it the object slips, above it not: the load of every event is what the scenario states.

    A load that arrives at once swings on the pad's spring to twice its size.
    """
    one = replace(weak(event), onset_s=1.0, lift_speed_mm_s=200.0)
    gain = one.pose.gripper.gain
    below = run_lift(replace(one, first_n=0.9 * one.needed_n / gain), "no guard")
    times = 2.0 if event in ("support gone", "mass added") else 1.1
    above = run_lift(replace(one, first_n=times * one.needed_n / gain), "no guard")
    assert above.slip_deg < 0.05
    assert above.up
    assert below.slip_deg > above.slip_deg or event == "lift"  # the far end on the table relieves a lift's first moment


def test_the_bound_uses_no_more_force_than_needed() -> None:
    one = weak("lift")
    bound = run_lift(one, "clairvoyant")
    assert bound.dropped is None
    assert bound.up
    assert 1.0 <= bound.force_over_needed < 1.02 + one.pose.gripper.force_step_n * 1.1 / one.needed_n
    assert bound.slip_deg < run_lift(one, "fixed step").slip_deg


def test_the_reactive_bound_acts_when_the_cameras_have_seen_the_object_move() -> None:
    """No earlier than one camera latency after the first motion, with the needed force."""
    one = weak("support gone")
    bound, clairvoyant = run_lift(one, "reactive"), run_lift(one, "clairvoyant")
    assert bound.tightenings == clairvoyant.tightenings == 1
    assert clairvoyant.slip_deg < bound.slip_deg
    slower = replace(one.pose.left, latency_s=one.pose.left.latency_s + 0.05)
    assert run_lift(replace(one, pose=replace(one.pose, left=slower)), "reactive").slip_deg > bound.slip_deg + 0.5


def test_the_reactive_bound_leaves_a_firm_grip_alone() -> None:
    one = next(one for one in SCENARIOS if one.firm and one.event == "lift")
    assert run_lift(one, "reactive").tightenings == 0


def test_baselines_tighten_after_slip() -> None:
    one = weak("contact")
    steps = run_lift(one, "naive 0.5°")
    assert steps.tightenings > 0
    assert not steps.early
    assert run_lift(one, "naive 0.5°") == steps


def test_a_constant_grips_with_its_share_of_the_limit() -> None:
    one = draw(0, 3, "lift", "slide", "soft")
    assert constant_n("constant 0.50", one) == pytest.approx(0.5 * one.force_max_n)
    assert constant_n("slipguard", one) == one.first_n


def test_a_dropped_object_counts_as_far_slipped() -> None:
    one = replace(weak("support gone"), first_n=20.0, needed_n=40.0)
    one = replace(one, mass_kg=6.0 * one.mass_kg)
    lost = run_lift(one, "no guard")
    assert lost.dropped is not None
    assert lost.slip_deg >= DROPPED_DEG


def test_a_held_object_is_disturbed_in_every_way_and_put_down() -> None:
    """A strong arm motion would lose it: a disturbance that reaches nothing would be none."""
    one = next(one for one in SCENARIOS if one.firm and one.event == "lift")
    held = run_lift(one, "slipguard", disturbed=True)
    assert [done.name for done in held.disturbed] == [*DISTURBANCES, LOWERING]
    assert [done.dropped for done in held.disturbed] == [False] * 4
    assert all(done.slip_deg < 0.5 and done.after_n >= done.before_n for done in held.disturbed)
    loose = replace(one, first_n=1.01 * one.needed_n / one.pose.gripper.gain)
    shaken = run_lift(loose, "no guard", disturbed=True)
    assert shaken.disturbed[0].name == "arm at 2 m/s²"
    assert max(done.slip_deg for done in shaken.disturbed) > 0.0


@pytest.mark.extras("mujoco")
@pytest.mark.parametrize("event", ["lift", "contact", "acceleration"])
def test_both_plants_agree_on_what_holds_and_what_slips(event: str) -> None:
    one = replace(weak(event), onset_s=1.0)
    gain = one.pose.gripper.gain
    for plant in ("own", "mujoco"):
        firm = run_lift(replace(one, first_n=1.25 * one.needed_n / gain), "no guard", plant)  # type: ignore[arg-type]
        loose = run_lift(replace(one, first_n=0.6 * one.base_needed_n / gain), "no guard", plant)  # type: ignore[arg-type]
        assert firm.slip_deg < 0.5, plant
        assert loose.slip_deg > 3.0, plant
