"""Respond to slip of a held object: tighten, and stop the arm.

The force only ever rises, to what the load needs (needed_force.py). Further steps follow one loop delay apart while the
object does not slow down. An episode ends when all has settled. A load that grows while the arm stands is answered
before it slips (elastic_share.py).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from slipguard.control import force_limits, grasp_model, needed_force
from slipguard.control.elastic_share import GROWS_MM, GROWS_S, GROWS_SHARE, growing_load
from slipguard.control.messages import Observation
from slipguard.control.needed_force import NeededForce
from slipguard.control.params import GuardParams
from slipguard.control.reports import Fault, FaultCode, Message, Text
from slipguard.control.slip_detector import (
    AGAIN_SHARE,
    TORSION_ON_TABLE_DEG,
    SlipAssessment,
    assess_slip,
    uncertainty_deg,
)
from slipguard.control.slip_memory import ArmCase
from slipguard.control.state import GraspState, Phase, SlipEpisode, gripper_at_rest

AGAIN_DEG = 2.5
"""While an object leaves the table, the grip is raised again after this further rotation, or beyond the elastic limit.
"""
SLOWING = 0.8
"""A rate below this share of that at the last step shows that the step works."""
PROGRESS_DEG = 1.0
PROGRESS_MM = 0.2
"""Another step follows only if the object has moved this much further since the last one, at the rate of slip,"""
CREPT_DEG = 3.0
CREPT_MM = 0.5
"""... or this much at any rate: friction that has once been overcome may creep."""
BEYOND_LIMIT_DEG = 5.0
BEYOND_LIMIT_MM = 1.0
"""At the force limit and with the arm stopped, this much further motion is no elastic torsion."""
AT_LIMIT_DEG = 25.0
"""Rotation at the force limit adds up over all pauses of the arm: a soft gel at that force twists less than this."""
UNSETTLED_S = 5.0
"""Slip that has neither settled nor been answered for this time never will: something shakes the object."""
RATE_LAG_S = 0.05
"""A rate is the slope of a tenth of a second."""
DELAY_MAX_S = 0.5
"""A longer delay of the gripper is not waited for."""
LATE_SHARE = 0.5
"""Beyond this share of `rotation_max_deg` the next step does not wait for the effect of the last one."""


@dataclass(frozen=True, slots=True)
class SlipResponse:
    """What follows from one step of guarding.

    Args:
        state: the new state.
        hold_n: tighten to this force.
        stop_arm: the arm must not move now.
        message, fault: to be reported.
    """

    state: GraspState
    hold_n: float | None = None
    stop_arm: bool = False
    message: Message | None = None
    fault: Fault | None = None


def respond_to_slip(state: GraspState, observation: Observation, params: GuardParams) -> SlipResponse:
    """Return the state after the newest estimate of a held object, and what to do about slip."""
    held = state.held
    if observation.fused is None or not state.guarding:
        return SlipResponse(state, stop_arm=held.slip is not None)
    elastic_limit = grasp_model.elastic_limit(state, params)
    force_range = force_limits.present_range(params, observation)
    at_limit = force_range is None or state.grip.target_n >= force_range.high_n
    seen = assess_slip(
        held.memory,
        observation.fused,
        params,
        arm=observation.arm,
        elastic_limit=elastic_limit,
        again_deg=TORSION_ON_TABLE_DEG if at_limit else max(AGAIN_DEG, AGAIN_SHARE * elastic_limit.deg),
        only_outward=state.phase is Phase.LOWERING or state.arm.putting_down,
    )
    slip = held.slip
    if slip is not None and seen.memory.baseline_changed(held.memory):
        slip = _progress_from(slip, seen)
    state = replace(state, held=replace(held, memory=seen.memory, slip=slip))
    state = _follow_at_limit(state, observation, at_limit=at_limit)
    far_frames = 1 if slip is not None and seen.moving else params.tuning.confirm_frames
    if held.referenced and seen.memory.far_frames >= far_frames:
        return _give_up(state, seen, observation, params)
    if _rotated_at_limit(state, observation, params):
        what = f"rotated from {abs(state.held.at_limit_deg or 0.0):.0f}° to {observation.rotation_deg:.0f}°"
        return SlipResponse(state, stop_arm=True, fault=_limit_reached(state, what, params))
    if slip is None:
        if seen.slipping:
            return _begin(state, seen, observation, params)
        return _raise_for_growth(
            grasp_model.learn_from_lift(state, seen, observation, params), seen, observation, params
        )
    if _has_settled(state, slip, seen, observation, params):
        memory = seen.memory.after_episode(rotated=slip.rotates, raised=slip.raised)
        state = replace(state, held=replace(state.held, memory=memory, slip=None))
        return SlipResponse(state, message=Text.SETTLED.message(force_n=state.grip.target_n))
    answer = _go_on(state, slip, seen, observation, params)
    if answer.hold_n is None and answer.fault is None and observation.now_s - slip.tightened_s >= UNSETTLED_S:
        return replace(answer, stop_arm=True, fault=_never_settled(state, seen))
    return answer


def _begin(state: GraspState, seen: SlipAssessment, observation: Observation, params: GuardParams) -> SlipResponse:
    """Take the first step."""
    now_s, slipping_n, grip = observation.now_s, state.grip.target_n, state.grip
    raised_from_n = state.held.raised_from_n
    if raised_from_n is not None and seen.memory.captured_s < grip.commanded_s + _delay_s(state, params):
        slipping_n = raised_from_n  # the raised grip shows only later
    state = replace(state, held=replace(state.held, growing=None, raised_from_n=None))
    state = grasp_model.learn_from_slip(state, seen, observation, params, slipping_n)
    slip = SlipEpisode(now_s, now_s, seen.rotation_deg, seen.rate_deg_s, seen.slip_mm)
    if slipping_n < grip.target_n and _needed_force(state, seen, params, slipping_n).force_n <= grip.target_n:
        slip = replace(slip, tightened_s=grip.commanded_s, rotates=seen.rotates, raised=True)
        return SlipResponse(_with_slip(state, slip), stop_arm=True)
    return _tighten(state, slip, seen, observation, params, slipping_n)


def _go_on(
    state: GraspState, slip: SlipEpisode, seen: SlipAssessment, observation: Observation, params: GuardParams
) -> SlipResponse:
    """Take another step if the last one has had its time and has no effect; report if nothing is left to do."""
    gripper = observation.gripper
    if gripper is not None and gripper.moving:
        slip = replace(slip, moved_s=gripper.measured_at_s)
    if seen.memory.captured_s < slip.tightened_s + _delay_s(state, params):  # from before the step could show
        return SlipResponse(_with_slip(state, _progress_from(slip, seen, with_rate=True)), stop_arm=True)
    if seen.memory.captured_s < slip.moved_s + RATE_LAG_S:  # a firmer grip moves the imprint: that is no slide
        slip = replace(slip, slip_mm=seen.slip_mm)
    state = _with_slip(state, slip)
    wait = SlipResponse(state, stop_arm=True)
    rotated_deg, moved_mm = seen.rotation_deg - slip.rotation_deg, seen.slip_mm - slip.slip_mm
    slips_on = seen.slides or (seen.moving and (rotated_deg > PROGRESS_DEG or moved_mm > PROGRESS_MM))
    if seen.elastic or not (slips_on or rotated_deg > _crept_deg(observation, params) or moved_mm > CREPT_MM):
        return wait
    at_rest = gripper is not None and gripper_at_rest(state, gripper)
    force_range = force_limits.present_range(params, observation)
    if force_range is None or state.grip.target_n >= force_range.high_n:
        beyond = seen.slides or rotated_deg > BEYOND_LIMIT_DEG or moved_mm > BEYOND_LIMIT_MM
        return replace(wait, fault=_limit_reached(state, seen.what, params)) if at_rest and beyond else wait
    slows = seen.rate_deg_s < SLOWING * slip.rate_deg_s and seen.slip_rate_mm_s < params.tuning.slip_rate_mm_s
    late = observation.rotation_deg > LATE_SHARE * params.tuning.rotation_max_deg
    if slows and not (late or seen.slides):  # the step works; from here on it counts whether it goes on slowing down
        return SlipResponse(_with_slip(state, _progress_from(slip, seen, with_rate=True)), stop_arm=True)
    if not (at_rest or late):
        return wait
    return _tighten(state, slip, seen, observation, params, state.grip.target_n)


def _raise_for_growth(
    state: GraspState, seen: SlipAssessment, observation: Observation, params: GuardParams
) -> SlipResponse:
    """Tighten before slip if a load that grows at rest will soon exceed its elastic limit."""
    memory, growing, share, gripper = seen.memory, state.held.growing, seen.share, observation.gripper
    growing = growing_load(growing, memory, share, seen.rotation_deg, seen.slip_mm)
    state = replace(state, held=replace(state.held, growing=growing))
    wait = SlipResponse(state)
    if growing is None or gripper is None or not gripper_at_rest(state, gripper) or _no_force(state, observation):
        return wait
    delay_s, captured_s = _delay_s(state, params), memory.captured_s
    if captured_s < max(growing.began_s + GROWS_S, state.grip.commanded_s + delay_s):
        return wait
    sigma_deg = observation.fused.sigma_deg if observation.fused is not None else None
    least_deg = max(memory.quick_threshold_deg(ArmCase.REST, params), uncertainty_deg(sigma_deg or 0.0, params))
    rotates = seen.rotation_deg - growing.from_deg >= least_deg
    soon = growing.soon(share, observation.now_s - captured_s + delay_s)
    force_range = force_limits.present_range(params, observation)
    moves = rotates or seen.slip_mm - growing.from_mm >= GROWS_MM
    if soon < 1.0 or not moves or share.used - growing.used < GROWS_SHARE or force_range is None:
        return wait
    steps = needed_force.GENTLE if params.gentle else needed_force.QUICK
    ratio = min(soon / max(growing.used, 1.0 / steps.margin), steps.margin * steps.ratio_least)
    present_n = state.grip.target_n
    needed = grasp_model.force_for(state, params, present_n, ratio, slides=not rotates)
    target_n = force_range.raised(present_n, needed.force_n)
    if target_n <= present_n:
        return wait
    what = f"from {growing.used:.2f} to {share.used:.2f} of the elastic limit, soon {soon:.2f}"
    message = Text.LOAD_GROWS.message(what=what, why=needed.reason, from_n=present_n, to_n=target_n)
    state = replace(state, held=replace(state.held, growing=None, raised_from_n=present_n))
    return SlipResponse(state.with_target(target_n, observation.now_s), target_n, message=message)


def _progress_from(slip: SlipEpisode, seen: SlipAssessment, *, with_rate: bool = False) -> SlipEpisode:
    """Return the episode with its progress counted from here on."""
    rate_deg_s = seen.rate_deg_s if with_rate else slip.rate_deg_s
    return replace(slip, rotation_deg=seen.rotation_deg, rate_deg_s=rate_deg_s, slip_mm=seen.slip_mm)


def _with_slip(state: GraspState, slip: SlipEpisode) -> GraspState:
    return replace(state, held=replace(state.held, slip=slip))


def _crept_deg(observation: Observation, params: GuardParams) -> float:
    """Return the further rotation that is not noise of the estimate."""
    fused = observation.fused
    sigma_deg = fused.sigma_deg if fused is not None and fused.sigma_deg is not None else 0.0
    return max(CREPT_DEG, uncertainty_deg(sigma_deg, params))


def _delay_s(state: GraspState, params: GuardParams) -> float:
    """Return the time from a command to the first frame that may show its effect, rate included."""
    delay_s = state.grip.delay.delay_s
    return RATE_LAG_S + (params.tuning.tighten_delay_s if delay_s is None else min(delay_s, DELAY_MAX_S))


def _tighten(
    state: GraspState,
    slip: SlipEpisode,
    seen: SlipAssessment,
    observation: Observation,
    params: GuardParams,
    slipping_n: float,
) -> SlipResponse:
    """Tighten to the force that the load needs, up to the force limit. slipping_n: force at which it slips."""
    if _no_force(state, observation):
        return SlipResponse(_with_slip(state, slip), stop_arm=True)
    force_range = force_limits.present_range(params, observation)
    present_n = target_n = state.grip.target_n
    needed = _needed_force(state, seen, params, slipping_n)
    if force_range is not None:
        target_n = force_range.raised(present_n, needed.force_n)
    slip = replace(
        _progress_from(slip, seen, with_rate=True),
        rotates=slip.rotates or seen.rotates,
        raised=slip.raised or target_n > present_n,
        tightened_s=observation.now_s,
    )
    state = _with_slip(state, slip)
    if target_n <= present_n:
        message = Text.AT_FORCE_LIMIT.message(what=seen.what, force_n=present_n)
        return SlipResponse(state, stop_arm=True, message=message)
    message = Text.TIGHTENING.message(what=seen.what, why=needed.reason, from_n=present_n, to_n=target_n)
    return SlipResponse(state.with_target(target_n, observation.now_s), target_n, stop_arm=True, message=message)


def _needed_force(state: GraspState, seen: SlipAssessment, params: GuardParams, slipping_n: float) -> NeededForce:
    """Return the force that the load needs: where it is still arriving, the next one to try."""
    steps = needed_force.GENTLE if params.gentle else needed_force.QUICK
    ratio = steps.search
    if seen.memory.arm.case is not ArmCase.LIFT_OFF:
        moved = seen.rotation_deg, seen.rate_deg_s, seen.slip_mm, seen.slip_rate_mm_s
        ratio = steps.margin * needed_force.load_ratio(*moved, params.lever_mm, steps.ratio_least)
    return grasp_model.force_for(state, params, slipping_n, ratio, slides=seen.translates and not seen.rotates)


def _no_force(state: GraspState, observation: Observation) -> bool:
    """Return whether no force may be added: a person may be near, or the gels press on each other after a loss."""
    gripper = observation.gripper
    return state.person.forbids_force or (gripper is not None and gripper.closed_on_nothing)


def _follow_at_limit(state: GraspState, observation: Observation, *, at_limit: bool) -> GraspState:
    """Return the state with the rotation at which the gripper first held with the force limit."""
    fused, gripper, from_deg = observation.fused, observation.gripper, state.held.at_limit_deg
    if not at_limit:
        return state if from_deg is None else replace(state, held=replace(state.held, at_limit_deg=None))
    if from_deg is not None or fused is None or fused.rotation_deg is None:
        return state
    if gripper is None or not gripper_at_rest(state, gripper):
        return state
    return replace(state, held=replace(state.held, at_limit_deg=fused.rotation_deg))


def _rotated_at_limit(state: GraspState, observation: Observation, params: GuardParams) -> bool:
    """Return whether the object has rotated outwards too far since the gripper first held with the force limit."""
    fused, from_deg = observation.fused, state.held.at_limit_deg
    if from_deg is None or fused is None or fused.rotation_deg is None or fused.conflict is not None:
        return False
    outward = abs(fused.rotation_deg) > abs(from_deg)
    return outward and abs(fused.rotation_deg - from_deg) > AT_LIMIT_DEG + uncertainty_deg(
        fused.sigma_deg or 0.0, params
    )


def _never_settled(state: GraspState, seen: SlipAssessment) -> Fault:
    return Fault(
        FaultCode.NOT_SETTLED,
        f"not at rest for {UNSETTLED_S:g} s after slip ({seen.what}) at {state.grip.target_n:.0f} N",
        "find what shakes the object or the arm, then clear",
    )


def _limit_reached(state: GraspState, what: str, params: GuardParams) -> Fault:
    return Fault(
        FaultCode.FORCE_LIMIT_REACHED,
        f"{what} at {state.grip.target_n:.0f} N, and the force limit is {params.force_max_n:g} N",
        "support the object, lower it or release it; raise the force limit if object and gel allow it",
    )


def _give_up(state: GraspState, seen: SlipAssessment, observation: Observation, params: GuardParams) -> SlipResponse:
    """Apply the force limit and report: the object is not being held."""
    force_range = force_limits.present_range(params, observation)
    present_n = target_n = state.grip.target_n
    if force_range is not None:
        target_n = force_range.allowed(params.force_max_n, present_n)
    tightens = target_n > present_n and not _no_force(state, observation)
    rate = f" and still rotating at {seen.rate_deg_s:.0f}°/s" if seen.moving else ""
    force = f": tightening from {present_n:.0f} N to {target_n:.0f} N" if tightens else ""
    fault = Fault(
        FaultCode.ROTATED_TOO_FAR,
        f"rotated {observation.rotation_deg:.0f}° since it was gripped{rate}{force}",
        "support the object and release it; grip it nearer to its center of mass",
    )
    if not tightens:
        return SlipResponse(state, stop_arm=True, fault=fault)
    return SlipResponse(state.with_target(target_n, observation.now_s), target_n, stop_arm=True, fault=fault)


def _has_settled(
    state: GraspState, slip: SlipEpisode, seen: SlipAssessment, observation: Observation, params: GuardParams
) -> bool:
    """Return whether all has been at rest for long enough, with the last step done and its effect seen."""
    at_rest = observation.gripper is not None and gripper_at_rest(state, observation.gripper)
    effect_seen = seen.memory.captured_s - slip.tightened_s >= _delay_s(state, params)
    return at_rest and effect_seen and not seen.slides and seen.settled_s >= params.tuning.settle_s
