"""What the controller learns of the gel when a lifted object hangs at rest."""

from __future__ import annotations

import pytest
from controller_steps import NOW_S, PRIMED, seen_in, state_in
from observations import fused
from records import changed

from slipguard.control import needed_force as need
from slipguard.control.grasp_model import REST_S, learn_from_lift
from slipguard.control.needed_force import FRICTION_PRIOR, ElasticMotion, LogNormal
from slipguard.control.params import GuardParams
from slipguard.control.slip_detector import SlipAssessment
from slipguard.control.slip_memory import SlipMemory
from slipguard.control.state import Phase

GEL = LogNormal(0.3, 0.5)
HANGS = changed(PRIMED, hangs=True, unloaded_deg=2.0, unloaded_mm=(0.1, -0.2))


def learned(memory: SlipMemory = HANGS, settled_s: float = REST_S, force_n: float = 60.0, **seen: object) -> LogNormal:
    """Return the stiffness after a first grip with 40 N that was raised to `force_n`, rotated by 5 degrees."""
    grasp = state_in(Phase.HOLDING, target_n=force_n, first_n=40.0, gel=GEL)
    view = changed(seen_in(Phase.HOLDING), fused=changed(fused(5.0, at_s=NOW_S), **seen))
    return learn_from_lift(grasp, SlipAssessment(memory, settled_s=settled_s), view, GuardParams()).gel


@pytest.mark.parametrize(
    ("unloaded_mm", "seen", "since_grip_mm", "since_step_mm"),
    [
        ((0.1, -0.2), {"shift_mm": 0.4, "sideways_mm": 0.2}, 0.2**0.5, 0.5),
        ((0.1, -0.2), {"shift_mm": 0.4, "sideways_mm": None}, 0.4, 0.13**0.5),
        ((0.1, -0.2), {"shift_mm": None, "sideways_mm": 0.3}, 0.0, 0.0),
        (None, {"shift_mm": 0.4, "sideways_mm": 0.3}, 0.5, 0.0),
    ],
)
def test_torsion_and_shear_count_from_the_grip_and_from_the_last_step(
    unloaded_mm: tuple[float, float] | None, seen: dict[str, object], since_grip_mm: float, since_step_mm: float
) -> None:
    since_grip = 40.0, ElasticMotion(5.0, since_grip_mm)
    since_step = 60.0, ElasticMotion(3.0, since_step_mm)
    found, expected = (
        learned(changed(HANGS, unloaded_mm=unloaded_mm), **seen),
        need.after_lift(since_grip, since_step, FRICTION_PRIOR, GEL),
    )
    assert (found.median, found.spread) == (pytest.approx(expected.median), pytest.approx(expected.spread))
    assert found != GEL


def test_it_learns_from_a_weak_grip_but_not_before_it_has_rested() -> None:
    assert learned(force_n=0.5) != GEL
    assert learned(settled_s=0.99 * REST_S) == GEL


def test_without_a_baseline_it_learns_nothing() -> None:
    assert learned(changed(HANGS, unloaded_deg=None)) == GEL
