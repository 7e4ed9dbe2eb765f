"""Single steps of the slip response: what it remembers, commands and reports."""

from __future__ import annotations

import math

import pytest
from controller_steps import NOW_S, PARAMS, PRIMED, Play, seen_in, state_in
from observations import arm, fused, gripper, guard_params
from records import changed

from slipguard.control.messages import Observation
from slipguard.control.needed_force import STIFFNESS_PRIOR, LogNormal
from slipguard.control.params import GuardParams
from slipguard.control.reports import FaultCode
from slipguard.control.slip_memory import ArmCase, SlipMemory
from slipguard.control.slip_response import UNSETTLED_S, SlipResponse, respond_to_slip
from slipguard.control.state import GraspState, GripperDelay, Phase, SlipEpisode

DELAY_S = 0.25
"""200 ms until a step is felt, 50 until a rate shows it."""
FORCE_LIMIT_N = 129.6


def slipping(
    rotation_deg: float = 4.0, rate_deg_s: float = 60.0, slip_mm: float = 0.0, since_s: float = 1.0
) -> SlipEpisode:
    """Tightened since_s ago, at this rotation and rate."""
    return SlipEpisode(NOW_S - since_s, NOW_S - since_s, rotation_deg, rate_deg_s, slip_mm, rotates=True, raised=True)


def state(slip: SlipEpisode | None = None, memory: SlipMemory = PRIMED, **changes: object) -> GraspState:
    return state_in(Phase.HOLDING, slip=slip, memory=memory, delay=GripperDelay(delay_s=0.2), **changes)


def view(
    rotation_deg: float | None = 0.0, rate_deg_s: float = 0.0, shift_mm: float = 0.0, **changes: object
) -> Observation:
    observation = seen_in(
        Phase.HOLDING, fused=fused(rotation_deg, rate_deg_s, at_s=NOW_S, shift_mm=shift_mm, sigma_deg=0.1)
    )
    return changed(observation, **changes)  # type: ignore[arg-type]


def respond(grasp: GraspState, observation: Observation, params: GuardParams = PARAMS) -> SlipResponse:
    return respond_to_slip(grasp, observation, params)


# --- nothing to see ---


@pytest.mark.parametrize("slip", [None, slipping()])
def test_with_nothing_seen_or_nothing_to_guard_an_arm_stopped_for_slip_stays_stopped(slip: SlipEpisode | None) -> None:
    for grasp, observation in (
        (state(slip), view(fused=None)),
        (state(slip, guarding=False), view(4.0, 60.0)),
    ):
        response = respond(grasp, observation)
        assert response == SlipResponse(grasp, stop_arm=slip is not None)


@pytest.mark.parametrize("rotation_deg", [4.0, 60.0], ids=["slip", "rotated too far"])
def test_gels_that_press_on_each_other_after_a_loss_are_not_tightened(rotation_deg: float) -> None:
    grasp = state(memory=changed(PRIMED, far_frames=5))
    closed = gripper(40.0, holding=False, nothing=True, width_mm=1.0, at_s=NOW_S)
    response = respond(grasp, view(rotation_deg, 60.0, gripper=closed))
    assert (response.hold_n, response.stop_arm) == (None, True)
    assert respond(grasp, view(rotation_deg, 60.0)).hold_n is not None


def test_a_firm_grip_tolerates_more_rotation_in_the_lift_off() -> None:
    lifting = changed(PRIMED, frames=1, case=ArmCase.LIFT_OFF)
    soft, stiff = LogNormal(0.3, 0.2), LogNormal(3.0, 0.2)
    for target_n, gel, slips in ((40.0, stiff, True), (40.0, soft, False), (4.0, soft, True)):
        observation = view(1.5, arm=arm(10.0, moving=True, at_s=NOW_S))
        grasp = state(memory=lifting, target_n=target_n, gel=gel)
        assert (respond(grasp, observation, GuardParams()).hold_n is not None) is slips


def test_a_moved_baseline_moves_the_start_of_the_last_steps_progress() -> None:
    lifting = changed(PRIMED, case=ArmCase.LIFT_OFF)
    response = respond(state(slipping(5.0, slip_mm=0.2), lifting), view(6.0, shift_mm=0.4))
    assert response.state.held.memory.baselines.episode_deg == 6.0
    assert response.state.held.slip is not None
    assert (response.state.held.slip.rotation_deg, response.state.held.slip.slip_mm) == (0.0, 0.0)


# --- the first step ---


def test_the_first_step_is_remembered_as_it_was() -> None:
    observation = view(7.0, 60.0, 0.4)
    response = respond(state(), observation)
    grasp = response.state
    rate_mm_s = grasp.held.memory.shift.rate_mm_s
    assert rate_mm_s > PARAMS.tuning.slip_rate_mm_s
    assert grasp.held.slip == SlipEpisode(NOW_S, NOW_S, 7.0, 60.0, 0.4, rotates=True, raised=True)
    assert response.hold_n == grasp.grip.target_n > 40.0
    assert grasp.grip.commanded_s == NOW_S
    assert response.stop_arm


@pytest.mark.parametrize("force_max_n", [60.0, 90.0, 130.0, 200.0])
def test_the_first_step_depends_on_the_load_and_not_on_the_force_limit(force_max_n: float) -> None:
    params = guard_params(force_max_n=force_max_n, no_estimate_force_n=50.0)
    response = respond(state(), view(7.0, 60.0), params)
    assert response.hold_n == pytest.approx(58.8, abs=0.1)
    assert response.message is not None
    assert "load 0.53 N·m, friction 0.58 ± 0.19: tightening from 40 N to 59 N" in response.message.text


def test_an_object_that_rotates_faster_lacks_more_force() -> None:
    slow, fast = (respond(state(), view(3.0, rate_deg_s)).hold_n or 0.0 for rate_deg_s in (60.0, 200.0))
    assert 40.0 < slow < fast


def test_a_slide_is_answered_in_proportion_to_its_load() -> None:
    response = respond(state(), view(0.0, 0.0, 2.5))
    assert response.message is not None
    assert "load 77.3 N, friction" in response.message.text
    assert response.hold_n == pytest.approx(40.0 * 1.61, abs=0.9)


def test_near_a_person_it_is_remembered_without_a_step() -> None:
    response = respond(state(person_near=True), view(7.0, 60.0, 0.4))
    assert response == SlipResponse(response.state, stop_arm=True)
    assert response.state.held.slip == SlipEpisode(NOW_S, NOW_S, 7.0, 60.0, 0.4)
    assert response.state.grip.target_n == 40.0


def test_a_gripper_above_the_force_limit_gets_no_command() -> None:
    response = respond(state(), view(7.0, 60.0, gripper_limits_n=(131.0, 235.0)))
    assert (response.hold_n, response.stop_arm) == (None, True)
    assert response.state.grip.target_n == 40.0


# --- further steps ---


def test_until_a_step_can_be_felt_progress_does_not_count() -> None:
    early = slipping(4.0, 60.0, 0.1, since_s=DELAY_S - 0.01)
    response = respond(state(early), view(9.0, 50.0, 0.3))
    assert response == SlipResponse(response.state, stop_arm=True)
    assert response.state.held.slip == changed(early, rotation_deg=9.0, rate_deg_s=50.0, slip_mm=0.3)
    felt = respond(state(slipping(4.0, 60.0, since_s=DELAY_S)), view(9.0, 60.0))
    assert felt.hold_n is not None


@pytest.mark.parametrize(
    ("rotation_deg", "shift_mm", "steps"), [(5.0, 0.0, False), (5.01, 0.0, True), (4.5, 0.2, False), (4.5, 0.21, True)]
)
def test_a_step_is_followed_by_another_only_if_the_object_moved_on(
    rotation_deg: float, shift_mm: float, steps: bool
) -> None:
    before = slipping(4.0)
    response = respond(state(before), view(rotation_deg, 70.0, shift_mm))
    assert (response.hold_n is not None) is steps
    assert response.stop_arm
    if not steps:
        assert response.state.held.slip == before
    else:
        assert response.state.held.slip is not None
        assert response.state.held.slip.tightened_s == response.state.grip.commanded_s == NOW_S
        assert response.state.held.slip.began_s == before.began_s
        assert (response.state.held.slip.rotation_deg, response.state.held.slip.rate_deg_s) == (rotation_deg, 70.0)
        assert response.state.held.slip.slip_mm == shift_mm


@pytest.mark.parametrize(
    ("sigma_deg", "rotation_deg", "steps"),
    [(0.1, 7.0, False), (0.1, 7.01, True), (1.5, 8.5, False), (1.5, 8.51, True), (9.0, 9.0, False), (9.0, 9.01, True)],
)
def test_a_step_is_followed_by_another_where_the_object_creeps_on(
    sigma_deg: float, rotation_deg: float, steps: bool
) -> None:
    creeping = fused(rotation_deg, 4.0, at_s=NOW_S, sigma_deg=sigma_deg)
    assert (respond(state(slipping(4.0, 4.0)), view(fused=creeping)).hold_n is not None) is steps


@pytest.mark.parametrize(("slid_mm", "steps"), [(0.5, False), (0.51, True)])
@pytest.mark.parametrize("rotation_deg", [None, 4.0])
def test_slow_translational_creep_is_tightened_again(rotation_deg: float | None, slid_mm: float, steps: bool) -> None:
    slow = changed(PRIMED, smooth_mm=slid_mm - 0.01, captured_s=NOW_S - 0.02)
    response = respond(state(slipping(4.0, 0.0), slow), view(rotation_deg, 0.0, slid_mm))
    assert response.stop_arm
    assert (response.hold_n is not None) is steps


@pytest.mark.parametrize(
    ("moving", "moved_s", "steps"), [(True, 0.5, False), (False, 0.04, False), (False, 0.06, True)]
)
def test_a_shift_while_the_force_rises_is_no_slide(moving: bool, moved_s: float, steps: bool) -> None:
    """A firmer grip moves the imprint of a sloping object; the rate of the shift shows it 50 ms longer."""
    before = changed(slipping(4.0, slip_mm=0.1), moved_s=NOW_S - moved_s)
    response = respond(state(before), view(4.5, 60.0, 0.6, gripper=gripper(40.0, moving=moving, at_s=NOW_S)))
    assert (response.hold_n is not None) is steps
    if not steps:
        moved_at_s = NOW_S if moving else before.moved_s
        assert response.state.held.slip == changed(before, moved_s=moved_at_s, slip_mm=0.6)


def test_translation_before_the_last_step_is_no_progress() -> None:
    assert respond(state(slipping(4.0, slip_mm=0.3)), view(4.5, 60.0, 0.4)).hold_n is None


@pytest.mark.parametrize(("rate_deg_s", "steps"), [(48.0, True), (47.9, False)])
def test_a_fifth_slower_is_help(rate_deg_s: float, steps: bool) -> None:
    before = slipping(4.0, 60.0)
    response = respond(state(before), view(8.0, rate_deg_s, 0.01))
    assert (response.hold_n is not None) is steps
    assert response.stop_arm
    if not steps:
        assert response == SlipResponse(response.state, stop_arm=True)
        assert response.state.held.slip == changed(before, rotation_deg=8.0, rate_deg_s=rate_deg_s, slip_mm=0.01)


@pytest.mark.parametrize(("rotation_deg", "steps"), [(22.5, False), (22.6, True), (-22.6, True)])
def test_half_way_to_giving_up_there_is_no_waiting(rotation_deg: float, steps: bool) -> None:
    rate_deg_s = 30.0 if rotation_deg > 0.0 else -30.0
    observation = view(rotation_deg, rate_deg_s, gripper=gripper(40.0, moving=True, at_s=NOW_S))
    assert (respond(state(slipping(4.0, 60.0)), observation).hold_n is not None) is steps


def test_continuing_translation_without_rotation_is_tightened_again() -> None:
    observation = view(None, shift_mm=1.0)
    response = respond(state(slipping(0.0, 0.0)), observation)
    assert response.hold_n is not None
    assert response.state.held.slip is not None
    assert response.message is not None
    assert "moved 1.0 mm" in response.message.text


# --- all the force there is ---


@pytest.mark.parametrize(
    ("rotation_deg", "shift_mm", "moving", "spent"),
    [
        (9.0, 0.0, False, False),
        (9.1, 0.0, False, True),
        (9.1, 0.0, True, False),
        (4.5, 1.0, False, False),
        (4.5, 1.1, False, True),
        (4.5, 1.1, True, False),
    ],
)
def test_continuing_motion_at_the_force_limit_is_a_fault(
    rotation_deg: float, shift_mm: float, moving: bool, spent: bool
) -> None:
    grasp = state(slipping(4.0), target_n=FORCE_LIMIT_N + 0.1)
    response = respond(grasp, view(rotation_deg, 60.0, shift_mm, gripper=gripper(130.0, moving=moving, at_s=NOW_S)))
    assert response.stop_arm
    assert response.hold_n is None
    if not spent:
        assert response.fault is None
    else:
        assert response.fault is not None
        assert response.fault.code is FaultCode.FORCE_LIMIT_REACHED
        slid = f", moved {shift_mm:.1f} mm" if shift_mm else ""
        assert (
            response.fault.observed
            == f"rotated {rotation_deg:.1f}° at 60°/s{slid} at 130 N, and the force limit is 130 N"
        )
        assert response.fault.what_to_do == (
            "support the object, lower it or release it; raise the force limit if object and gel allow it"
        )


# --- giving up ---


def test_one_frame_beyond_is_enough_while_it_slips_and_rotates() -> None:
    response = respond(state(slipping(4.0)), view(45.1, 60.0))
    assert response.fault is not None
    assert response.fault.code is FaultCode.ROTATED_TOO_FAR
    assert response.fault.observed == (
        "rotated 45° since it was gripped and still rotating at 60°/s: tightening from 40 N to 130 N"
    )
    assert response.fault.what_to_do == "support the object and release it; grip it nearer to its center of mass"
    assert response.stop_arm
    assert response.hold_n == response.state.grip.target_n == pytest.approx(FORCE_LIMIT_N, abs=0.1)
    assert response.state.grip.commanded_s == NOW_S


@pytest.mark.parametrize(("slip", "rate_deg_s"), [(None, 60.0), (slipping(4.0), 0.0)])
def test_else_it_takes_two(slip: SlipEpisode | None, rate_deg_s: float) -> None:
    quiet = changed(PRIMED, frames=0)
    assert respond(state(slip, quiet), view(46.0, rate_deg_s)).fault is None
    again = respond(state(slip, changed(quiet, far_frames=1)), view(46.0, rate_deg_s))
    assert again.fault is not None
    assert again.fault.code is FaultCode.ROTATED_TOO_FAR


@pytest.mark.parametrize(
    "changes",
    [{"person_near": True}, {"target_n": 130.0}],
)
def test_given_up_without_more_force(changes: dict[str, object]) -> None:
    grasp = state(slipping(4.0), **changes)
    response = respond(grasp, view(46.0, 60.0))
    assert (response.hold_n, response.stop_arm) == (None, True)
    assert response.fault is not None
    assert (response.state.grip.target_n, response.state.grip.commanded_s) == (
        grasp.grip.target_n,
        grasp.grip.commanded_s,
    )
    weak = respond(state(slipping(4.0)), view(46.0, 60.0, gripper_limits_n=(131.0, 235.0)))
    assert (weak.hold_n, weak.state.grip.target_n) == (None, 40.0)


# --- settled ---


def resting(for_s: float) -> SlipMemory:
    return changed(PRIMED, settled_deg=4.5, settled_since_s=NOW_S - for_s, episode_deg=0.0)


@pytest.mark.parametrize(
    ("rested_s", "since_s", "changes", "settled"),
    [
        (0.5, 1.0, {}, True),
        (0.25, 1.0, {}, False),
        (0.5, DELAY_S, {}, True),
        (0.5, DELAY_S - 0.01, {}, False),
        (0.5, 1.0, {"gripper": None}, False),
        (0.5, 1.0, {"gripper": gripper(40.0, moving=True, at_s=NOW_S)}, False),
    ],
)
def test_settled_means_at_rest_with_the_last_step_done_and_seen(
    rested_s: float, since_s: float, changes: dict[str, object], settled: bool
) -> None:
    response = respond(state(slipping(4.0, since_s=since_s), resting(rested_s)), view(4.5, **changes))
    assert (response.state.held.slip is None) is settled
    assert (str(response.message) == "settled at 40 N") is settled
    assert response.stop_arm is not settled
    if settled:
        assert response.state.held.memory.rotations == 1
        assert response.state.held.memory.baselines.episode_deg is None
        assert response.state.held.memory.baselines.episode_mm is None


def test_settling_takes_the_configured_time() -> None:
    for calm_s, settled in ((0.5, True), (0.51, False)):
        params = PARAMS.model_copy(update={"tuning": PARAMS.tuning.model_copy(update={"settle_s": calm_s})})
        assert (respond(state(slipping(4.0), resting(0.5)), view(4.5), params).state.held.slip is None) is settled


# --- what a grasp shows about the gel ---


@pytest.mark.parametrize(
    ("changes", "learns"),
    [
        ({}, True),
        ({"hangs": False}, False),
        ({"settled_since_s": NOW_S - 0.2}, False),
    ],
)
def test_an_object_that_rests_in_the_air_shows_the_gels_stiffness(changes: dict[str, object], learns: bool) -> None:
    rests = changed(PRIMED, **({"hangs": True, "frames": 0} | changes))
    grasp = respond(state(memory=rests), view()).state
    assert (grasp.gel != STIFFNESS_PRIOR) is learns is grasp.held.gel_learned
    again = respond(grasp, view()).state
    assert again.gel == grasp.gel


@pytest.mark.parametrize("changes", [{"gel_learned": True}, {"referenced": False}, {"target_n": 0.0}])
def test_each_grasp_shows_it_once_and_only_with_a_reference_and_a_force(changes: dict[str, object]) -> None:
    rests = changed(PRIMED, hangs=True, frames=0)
    assert respond(state(memory=rests, **changes), view()).state.gel == STIFFNESS_PRIOR


def test_without_a_rotation_it_shows_nothing() -> None:
    rests = changed(PRIMED, hangs=True, frames=0)
    assert respond(state(memory=rests), view(None)).state.gel == STIFFNESS_PRIOR


def test_elastic_motion_after_a_step_is_not_answered_with_another_one() -> None:
    """A shaken object on a soft gel: 1.2 degrees and 0.6 mm, of which the gel bears more than 5 degrees and 1 mm."""
    moves = view(1.2, 30.0, 0.6)
    for gel, tightens in ((LogNormal(0.15, 0.3), False), (LogNormal(5.0, 0.3), True)):
        assert (respond(state(slipping(0.0, 0.0), gel=gel), moves).hold_n is not None) is tightens


def test_the_first_rotational_slip_shows_the_friction_and_none_shows_the_gel() -> None:
    first = respond(state(), view(7.0, 60.0)).state
    assert first.held.friction is not None
    assert (first.held.first_n, first.gel) == (40.0, STIFFNESS_PRIOR)
    second = respond(changed(state(target_n=60.0), friction=first.held.friction, first_n=40.0), view(7.0, 60.0)).state
    assert (second.held.friction, second.held.first_n) == (first.held.friction, 40.0)
    weightless = respond(state(target_n=0.0), view(7.0, 60.0)).state
    assert (weightless.held.friction, weightless.gel) == (None, STIFFNESS_PRIOR)
    slide = respond(state(), view(0.0, 0.0, 2.5)).state
    assert (slide.held.friction, slide.held.first_n, slide.gel) == (None, 40.0, STIFFNESS_PRIOR)


def test_what_was_learned_of_the_gel_outlasts_the_grasp() -> None:
    known = LogNormal(0.5, 0.4)
    assert state(gel=known).emptied(Phase.IDLE, NOW_S).gel == known


# --- waits end ---


@pytest.mark.parametrize("amplitude", [{"rotation_deg": 1.2}, {"shift_mm": 0.35}], ids=["rotation", "shift"])
def test_slip_that_never_settles_is_a_fault_after_five_seconds(amplitude: dict[str, float]) -> None:
    """Vibration of 13 Hz after a slip."""
    play = Play().held()
    play.slips(4.0, 60.0)
    rest = changed(play.view, rate_deg_s=0.0)
    for number in range(350):
        phase = math.sin(2.0 * math.pi * 13.0 * 0.02 * number)
        moved = {"rotation_deg": 4.0 + phase * amplitude.get("rotation_deg", 0.0)}
        play.view = changed(rest, **moved, shift_mm=phase * amplitude.get("shift_mm", 0.0))
        if play.step().fault is not None:
            break
    assert play.grasp.fault is not None
    assert play.grasp.fault.code is FaultCode.NOT_SETTLED
    assert number * 0.02 == pytest.approx(UNSETTLED_S, abs=0.1)


def test_slip_after_the_fault_of_one_that_never_settled_is_answered_with_force() -> None:
    play = Play().held()
    play.slips(4.0, 60.0)
    rest = changed(play.view, rate_deg_s=0.0)
    for number in range(350):
        play.view = changed(rest, rotation_deg=4.0 + 1.2 * math.sin(2.0 * math.pi * 13.0 * 0.02 * number))
        play.step()
    assert play.grasp.fault is not None
    assert play.grasp.fault.code is FaultCode.NOT_SETTLED
    before_n = play.grasp.grip.target_n
    for number in range(30):
        play.view = changed(rest, rotation_deg=4.0 + 1.0 * number, rate_deg_s=50.0)
        play.step()
    assert play.grasp.grip.target_n > before_n


def test_rotation_at_the_force_limit_adds_up_over_pauses() -> None:
    play = Play(guard_params(force_max_n=60.0, no_estimate_force_n=60.0, first_force_n=60.0)).held()
    for rest_deg in (7.0, 14.0, 21.0, 28.0):
        assert play.grasp.fault is None
        play.slips(rest_deg, 20.0)
        play.view = changed(play.view, rate_deg_s=0.0)
        play.steps(1.0)
    assert play.grasp.fault is not None
    assert play.grasp.fault.code is FaultCode.FORCE_LIMIT_REACHED
    assert "from 0° to 28°" in str(play.grasp.fault)


@pytest.mark.parametrize(
    "changes",
    [{"rotation_deg": -15.0}, {"rotation_deg": None, "declined": "round contact"}, {"conflict": "one is stuck"}],
    ids=["back", "no estimate", "contradiction"],
)
def test_only_certain_rotation_outwards_adds_up(changes: dict[str, object]) -> None:
    grasp = state(target_n=129.61, at_limit_deg=15.5, commanded_s=float("-inf"))
    observation = view(41.0)
    assert respond(grasp, observation).fault is not None
    other = fused(**({"rotation_deg": 41.0, "at_s": NOW_S} | changes))
    assert respond(grasp, changed(observation, fused=other)).fault is None


def test_the_rotation_at_the_force_limit_counts_from_the_first_rest_there() -> None:
    at_limit = state(target_n=129.61, commanded_s=float("-inf"))
    assert respond(at_limit, view(0.2)).state.held.at_limit_deg == 0.2
    for missing in ({"gripper": None}, {"gripper": gripper(FORCE_LIMIT_N, moving=True, at_s=NOW_S)}):
        assert respond(at_limit, view(0.2, **missing)).state.held.at_limit_deg is None
    blind = view(None, fused=fused(None, declined="round contact", at_s=NOW_S))
    assert respond(at_limit, blind).state.held.at_limit_deg is None
    assert respond(state(target_n=40.0, at_limit_deg=3.0), view(0.2)).state.held.at_limit_deg is None
