"""A load that grows while the object hangs at rest: seen in the elastic motion of the gel, and answered before slip."""

from __future__ import annotations

import pytest
from controller_steps import NOW_S, PRIMED, seen_in, state_in
from observations import fused, gripper, guard_params
from records import changed

from slipguard.control import needed_force as need
from slipguard.control.elastic_share import GROWS_MM, NO_SHARE, ElasticShare, GrowingLoad, elastic_share, growing_load
from slipguard.control.finger_fusion import FusedEstimate
from slipguard.control.messages import Observation
from slipguard.control.needed_force import FRICTION_PRIOR, ElasticMotion, LogNormal
from slipguard.control.params import GuardParams
from slipguard.control.slip_memory import ArmCase, SlipMemory
from slipguard.control.slip_response import SlipResponse, respond_to_slip
from slipguard.control.state import GraspState, GripperDelay, Phase

GEL = LogNormal(0.3, 0.2)
LIMIT = need.elastic_limit(40.0, FRICTION_PRIOR, GEL)
HANGS = changed(PRIMED, hangs=True, frames=0)
GROWN = GrowingLoad(NOW_S - 0.2, 0.4, 0.4 * LIMIT.deg, 0.0)
DELAY_S = 0.25
PARAMS = GuardParams()


def state(growing: GrowingLoad | None = GROWN, **changes: object) -> GraspState:
    values: dict[str, object] = {"memory": HANGS, "gel": GEL, "gel_learned": True, "growing": growing}
    return state_in(Phase.HOLDING, delay=GripperDelay(delay_s=0.2), **(values | changes))


def view(share: float = 0.8, rate: float = 2.0, **changes: object) -> Observation:
    """This share of the elastic limit, as torsion alone, and its rate."""
    seen = fused(share * LIMIT.deg, rate * LIMIT.deg, at_s=NOW_S, sigma_deg=0.1)
    return changed(seen_in(Phase.HOLDING, fused=seen), **changes)  # type: ignore[arg-type]


def respond(grasp: GraspState, observation: Observation, params: GuardParams = PARAMS) -> SlipResponse:
    return respond_to_slip(grasp, observation, params)


def test_torsion_and_shear_use_the_limit_together() -> None:
    memory = changed(PRIMED, unloaded_deg=1.0, unloaded_mm=(0.1, 0.0))
    share = elastic_share(memory, fused(4.0, 2.0, shift_mm=0.5), ElasticMotion(10.0, 1.0))
    assert share.used == pytest.approx(0.5)
    assert share.rate == pytest.approx(0.3 * 0.2 / 0.5)


@pytest.mark.parametrize(
    ("memory", "seen", "limit"),
    [
        (PRIMED, fused(4.0, 2.0), ElasticMotion()),
        (PRIMED, fused(None, shift_mm=None), ElasticMotion(10.0, 1.0)),
        (changed(PRIMED, unloaded_deg=None, unloaded_mm=None), fused(4.0, 2.0), ElasticMotion(10.0, 1.0)),
    ],
)
def test_nothing_is_used_of_an_unknown_limit_or_by_an_unknown_motion(
    memory: SlipMemory, seen: FusedEstimate, limit: ElasticMotion
) -> None:
    assert elastic_share(memory, seen, limit) == NO_SHARE


@pytest.mark.parametrize(
    "changes", [{"case": ArmCase.MOVING}, {"case": ArmCase.LIFT_OFF}, {"hangs": False}, {"captured_s": NOW_S}]
)
def test_a_load_grows_only_on_an_object_that_hangs_at_rest(changes: dict[str, object]) -> None:
    memory = changed(HANGS, **changes)
    found = growing_load(None, memory, ElasticShare(0.5, 0.2), 2.0, 0.1)
    hangs_at_rest = memory.arm.hangs and memory.arm.case is ArmCase.REST
    assert found == (GrowingLoad(NOW_S, 0.5, 2.0, 0.1) if hangs_at_rest else None)


def test_growth_counts_from_where_it_began_until_it_ends() -> None:
    assert growing_load(GROWN, HANGS, ElasticShare(0.5, 0.2), 2.0, 0.1) is GROWN
    assert growing_load(GROWN, HANGS, ElasticShare(0.5, 0.1), 2.0, 0.1) is None


@pytest.mark.parametrize(("rate", "soon"), [(0.5, 0.9), (1.0, 1.0), (9.0, 1.2)])
def test_no_more_growth_is_expected_than_has_been_seen(rate: float, soon: float) -> None:
    assert GROWN.soon(ElasticShare(0.8, rate), 0.2) == pytest.approx(soon)


def test_a_load_that_grows_is_answered_before_slip() -> None:
    expected_n = 40.0 * (1.2 * 1.15) ** (1.0 / (1.0 + need.PAD.gamma))
    response = respond(state(), view())
    assert response.hold_n == response.state.grip.target_n == pytest.approx(expected_n, abs=0.9)
    assert response.message is not None
    assert "the load grows: from 0.40 to 0.80 of the elastic limit, soon 1.20: load" in response.message.text
    assert "tightening from 40 N to" in response.message.text
    assert (response.state.held.growing, response.state.held.raised_from_n) == (None, 40.0)
    assert response.state.grip.commanded_s == NOW_S
    assert response.state.held.slip is None
    assert not response.stop_arm


def test_a_fragile_object_gets_smaller_steps() -> None:
    quick, gentle = (respond(state(), view(), guard_params(gentle=gentle)).hold_n for gentle in (False, True))
    assert quick is not None
    assert gentle is not None
    assert 40.0 < gentle < quick


def test_a_pure_slide_is_answered_in_proportion() -> None:
    seen = fused(0.0, 0.0, at_s=NOW_S, shift_mm=0.9 * LIMIT.mm, sigma_deg=0.1)
    sliding = changed(HANGS, smooth_mm=0.6 * LIMIT.mm)
    grasp = state(GrowingLoad(NOW_S - 0.2, 0.4, 0.0, 0.4 * LIMIT.mm), memory=sliding)
    response = respond(grasp, view(fused=seen))
    assert response.hold_n is not None
    assert response.message is not None
    assert " N, friction" in response.message.text  # the load is a force


@pytest.mark.parametrize(
    ("grasp", "observation"),
    [
        (state(), view(0.45)),
        (state(), view(0.8, 0.1)),
        (state(), view(0.8, 0.3)),
        (state(GrowingLoad(NOW_S - 0.04, 0.4, 0.4 * LIMIT.deg, 0.0)), view()),
        (state(GrowingLoad(NOW_S - 0.2, 0.4, 0.8 * LIMIT.deg - 0.1, 0.0)), view()),
        (state(GrowingLoad(NOW_S - 0.2, 0.95, 0.4 * LIMIT.deg, 0.0)), view(0.99, 9.0)),
        (state(commanded_s=NOW_S - DELAY_S + 0.05), view()),
        (state(), view(gripper=None)),
        (state(), view(gripper=gripper(40.0, moving=True, at_s=NOW_S))),
        (state(person_near=True), view()),
        (state(), view(gripper_limits_n=(150.0, 235.0))),
        (state(None), view()),
    ],
    ids=[
        "far below the limit", "slow", "not soon", "short", "noise", "creep", "not felt yet", "no gripper",
        "tightening", "person near", "no force range", "just begun",
    ],
)  # fmt: skip
def test_it_waits(grasp: GraspState, observation: Observation) -> None:
    assert respond(grasp, observation).hold_n is None


def test_growth_begins_with_what_is_seen_then() -> None:
    seen = fused(0.6 * LIMIT.deg, 2.0 * LIMIT.deg, at_s=NOW_S, shift_mm=0.5 * LIMIT.mm, sigma_deg=0.1)
    memory = changed(HANGS, smooth_mm=0.5 * LIMIT.mm)
    growing = respond(state(None, memory=memory), view(fused=seen)).state.held.growing
    assert growing is not None
    assert (growing.began_s, growing.from_deg) == (NOW_S, pytest.approx(0.6 * LIMIT.deg))
    assert growing.from_mm == pytest.approx(0.5 * LIMIT.mm)


def test_a_rotation_within_its_uncertainty_is_no_growth() -> None:
    uncertain = changed(view(), sigma_deg=0.4 * LIMIT.deg)
    assert respond(state(), uncertain).hold_n is None


def test_a_slide_counts_from_where_the_growth_began() -> None:
    seen = fused(0.0, 0.0, at_s=NOW_S, shift_mm=0.9 * LIMIT.mm, sigma_deg=0.1)
    memory = changed(HANGS, smooth_mm=0.6 * LIMIT.mm)
    grasp = state(GrowingLoad(NOW_S - 0.2, 0.4, 0.0, 0.9 * LIMIT.mm - 0.5 * GROWS_MM), memory=memory)
    assert respond(grasp, view(fused=seen)).hold_n is None


def test_at_the_force_limit_nothing_is_left_to_raise() -> None:
    limit = need.elastic_limit(129.6, FRICTION_PRIOR, GEL)
    seen = fused(0.8 * limit.deg, 2.0 * limit.deg, at_s=NOW_S, sigma_deg=0.1)
    growing = GrowingLoad(NOW_S - 0.2, 0.4, 0.4 * limit.deg, 0.0)
    for target_n, raises in ((130.0, False), (128.0, True)):
        assert (respond(state(growing, target_n=target_n), view(fused=seen)).hold_n is not None) is raises


# --- slip that shows before the raised grip can have had its effect ---


def slips(rate_deg_s: float = 60.0) -> Observation:
    return view(fused=fused(7.0, rate_deg_s, at_s=NOW_S, sigma_deg=0.1))


def raised(to_n: float, ago_s: float = 0.1) -> GraspState:
    stiff = LogNormal(30.0, 0.2)
    memory = changed(HANGS, frames=1)
    return state(memory=memory, gel=stiff, target_n=to_n, commanded_s=NOW_S - ago_s, raised_from_n=40.0)


def test_a_grip_that_is_raised_far_enough_already_is_waited_for() -> None:
    response = respond(raised(70.0), slips())
    slip = response.state.held.slip
    assert response.hold_n is None
    assert response.stop_arm
    assert slip is not None
    assert (slip.tightened_s, slip.raised, slip.rotates) == (NOW_S - 0.1, True, True)
    assert response.state.held.raised_from_n is None
    assert response.state.held.first_n == 40.0


def test_otherwise_the_step_counts_from_the_force_before() -> None:
    plain = respond(state(memory=changed(HANGS, frames=1), gel=LogNormal(30.0, 0.2)), slips()).hold_n
    assert respond(raised(45.0), slips()).hold_n == plain


def test_once_the_raised_grip_shows_a_slip_counts_from_it() -> None:
    later = respond(raised(45.0, ago_s=0.3), slips()).hold_n
    assert later == pytest.approx(58.8 * 45.0 / 40.0, rel=0.02)
