"""The heart of the law: watch a held object, and tighten when it slips.

The force only ever rises. The first step is large, for a loop delay passes before its effect is seen; further steps
follow one loop delay apart while the object does not slow down. An episode ends when all has been calm for a while.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from slipguard.control import force_limits as limits
from slipguard.control.fault import Fault, FaultCode
from slipguard.control.messages import Observation
from slipguard.control.params import GuardParams
from slipguard.control.slip_detector import SlipAssessment, look
from slipguard.control.slip_thresholds import unsure_deg
from slipguard.control.state import GraspState, Phase, SlipEpisode, gripper_at_rest

SLOWING = 0.8
"""A rate below this share of that at the last step says that the step helps."""
PROGRESS_DEG = 1.0
PROGRESS_MM = 0.2
"""A step is answered by another only if the object has moved this much further since, at the rate of slip,"""
CREPT_DEG = 3.0
CREPT_MM = 0.5
"""... or this much however slowly: friction that has once been overcome may creep."""
SPENT_DEG = 5.0
SPENT_MM = 1.0
"""With the whole budget applied and the arm stopped, moving this much further is no wind-up of the gel."""
RATE_LAG_S = 0.05
"""A rate is the slope of a tenth of a second."""
FELT_MAX_S = 0.5
"""A gripper that took longer to close was not waited for."""
LATE_SHARE = 0.5
"""Beyond this share of `give_up_rotation_deg` there is no waiting whether a step helps."""


@dataclass(frozen=True, slots=True)
class GuardResult:
    """What one tick of guarding found. hold_n: tighten to this. stop: the arm must not move now."""

    state: GraspState
    hold_n: float | None = None
    stop: bool = False
    say: str | None = None
    fault: Fault | None = None


def guard(state: GraspState, observation: Observation, params: GuardParams) -> GuardResult:
    """One tick: the new memory and what to do about it."""
    if observation.fused is None or not state.guarding:
        return GuardResult(state, stop=state.slip is not None)
    sight = look(
        state.detector,
        observation.fused,
        params,
        arm=observation.arm,
        firm=state.target_n >= limits.firm_n(params, observation.gripper_limits_n),
        only_outward=state.phase is Phase.LOWERING,
    )
    slip = state.slip
    if slip is not None and sight.detector.elsewhere(state.detector):
        # Turns count from another place now: so must those of the last step.
        slip = replace(slip, rotation_deg=sight.rotation_deg, slip_mm=sight.slip_mm)
    state = replace(state, detector=sight.detector, slip=slip)
    far_frames = 1 if slip is not None and sight.moving else params.tuning.confirm_frames
    if state.referenced and sight.detector.far_frames >= far_frames:
        return _give_up(state, sight, observation, params)
    if slip is None:
        return _begin(state, sight, observation, params) if sight.slipping else GuardResult(state)
    if _calm(state, slip, sight, observation, params):
        detector = sight.detector.rebased(rotated=slip.rotations, slid=slip.slides, raised=slip.raised)
        state = replace(state, slip=None, detector=detector)
        return GuardResult(state, say=f"calm at {state.target_n:.0f} N")
    return _go_on(state, slip, sight, observation, params)


def _begin(state: GraspState, sight: SlipAssessment, observation: Observation, params: GuardParams) -> GuardResult:
    """The first, large step."""
    slip = SlipEpisode(observation.now_s, observation.now_s, sight.rotation_deg, sight.rate_deg_s, sight.slip_mm)
    firm_n = limits.firm_n(params, observation.gripper_limits_n)
    return _step(replace(state, slip=slip), slip, sight, observation, params, params.tuning.first_multiplier, firm_n)


def _go_on(
    state: GraspState, slip: SlipEpisode, sight: SlipAssessment, observation: Observation, params: GuardParams
) -> GuardResult:
    """Another step if the last one has had its time and does not help; a fault if there is nothing left to do."""
    waiting = GuardResult(state, stop=True)
    if sight.detector.captured_s < slip.stepped_s + _felt_s(state, params):
        # What is seen is from before the step could help: progress counts from here on.
        slip = replace(slip, rotation_deg=sight.rotation_deg, rate_deg_s=sight.rate_deg_s, slip_mm=sight.slip_mm)
        return GuardResult(replace(state, slip=slip), stop=True)
    rotated_deg, slid_mm = sight.rotation_deg - slip.rotation_deg, sight.slip_mm - slip.slip_mm
    slips_on = sight.moving and (rotated_deg > PROGRESS_DEG or slid_mm > PROGRESS_MM)
    if not (slips_on or rotated_deg > _crept_deg(observation, params) or slid_mm > CREPT_MM):
        return waiting
    at_rest = observation.gripper is not None and gripper_at_rest(state, observation.gripper)
    within = limits.budget(params.force_max_n, observation.gripper_limits_n)
    if within is None or state.target_n >= within.high_n:
        further = rotated_deg > SPENT_DEG or slid_mm > SPENT_MM
        return replace(waiting, fault=_spent(state, sight, params)) if at_rest and further else waiting
    slows = sight.rate_deg_s < SLOWING * slip.rate_deg_s and sight.slip_rate_mm_s < params.tuning.slip_rate_mm_s
    late = _rotated_deg(observation) > LATE_SHARE * params.tuning.rotation_max_deg
    if slows and not late:  # it helps: what counts is whether it goes on slowing down
        slip = replace(slip, rotation_deg=sight.rotation_deg, rate_deg_s=sight.rate_deg_s, slip_mm=sight.slip_mm)
        return GuardResult(replace(state, slip=slip), stop=True)
    if not (at_rest or late):
        return waiting
    return _step(state, slip, sight, observation, params, params.tuning.next_multiplier)


def _crept_deg(observation: Observation, params: GuardParams) -> float:
    """How much further is no noise of the estimate."""
    sigma_deg = (
        observation.fused.sigma_deg
        if observation.fused is not None and observation.fused.sigma_deg is not None
        else 0.0
    )
    return max(CREPT_DEG, unsure_deg(sigma_deg, params))


def _felt_s(state: GraspState, params: GuardParams) -> float:
    """From a command to the first frame that may show its effect, rate included."""
    felt_s = state.delay.felt_s
    return RATE_LAG_S + (params.tuning.tighten_delay_s if felt_s is None else min(felt_s, FELT_MAX_S))


def _step(
    state: GraspState,
    slip: SlipEpisode,
    sight: SlipAssessment,
    observation: Observation,
    params: GuardParams,
    base: float,
    least_n: float = 0.0,
) -> GuardResult:
    """Tighten by a multiple of the present force, to `least_n` at least, as far as the budget goes."""
    if state.person_near:
        return GuardResult(state, stop=True)
    within = limits.budget(params.force_max_n, observation.gripper_limits_n)
    multiple = limits.multiple(base, sight.rate_deg_s, params.tuning.multiplier_per_100_deg_s)
    target_n = state.target_n
    if within is not None:
        target_n = limits.allowed(least_n, limits.raised(state.target_n, multiple, within), within)
    slip = replace(
        slip,
        rotations=slip.rotations or sight.rotations,
        slides=slip.slides or sight.slides,
        raised=slip.raised or target_n > state.target_n,
        stepped_s=observation.now_s,
        rotation_deg=sight.rotation_deg,
        rate_deg_s=sight.rate_deg_s,
        slip_mm=sight.slip_mm,
    )
    if target_n > state.target_n:
        said = f"slip: {sight.what}: tightening from {state.target_n:.0f} N to {target_n:.0f} N"
        state = replace(state, slip=slip, target_n=target_n, commanded_s=observation.now_s)
        return GuardResult(state, hold_n=target_n, stop=True, say=said)
    said = f"slip: {sight.what}: {state.target_n:.0f} N is all the force there is"
    return GuardResult(replace(state, slip=slip), stop=True, say=said)


def _spent(state: GraspState, sight: SlipAssessment, params: GuardParams) -> Fault:
    return Fault(
        FaultCode.BUDGET_SPENT,
        f"{sight.what} at {state.target_n:.0f} N, and force_max_n = {params.force_max_n:g} N",
        "support the object, lower it or release it; raise force_max_n if object and gel allow it",
    )


def _give_up(state: GraspState, sight: SlipAssessment, observation: Observation, params: GuardParams) -> GuardResult:
    """It is not being held: all the force there is, and a fault."""
    still = f" and still turning at {sight.rate_deg_s:.0f}°/s" if sight.moving else ""
    fault = Fault(
        FaultCode.TURNED_TOO_FAR,
        f"turned {_rotated_deg(observation):.0f}° since it was gripped{still}",
        "support the object and release it; grip it nearer to its centre of mass",
    )
    within = limits.budget(params.force_max_n, observation.gripper_limits_n)
    target_n = limits.allowed(params.force_max_n, state.target_n, within) if within is not None else state.target_n
    if state.person_near or target_n <= state.target_n:
        return GuardResult(state, stop=True, fault=fault)
    state = replace(state, target_n=target_n, commanded_s=observation.now_s)
    return GuardResult(state, hold_n=target_n, stop=True, fault=fault)


def _calm(
    state: GraspState, slip: SlipEpisode, sight: SlipAssessment, observation: Observation, params: GuardParams
) -> bool:
    """At rest for long enough, with the last step done and its effect seen."""
    at_rest = observation.gripper is not None and gripper_at_rest(state, observation.gripper)
    seen_since = sight.detector.captured_s - slip.stepped_s >= _felt_s(state, params)
    return at_rest and seen_since and sight.still_s >= params.tuning.settle_s


def _rotated_deg(observation: Observation) -> float:
    """Turn since the reference, without sign; 0 where it cannot be told."""
    return (
        abs(observation.fused.rotation_deg)
        if observation.fused is not None and observation.fused.rotation_deg is not None
        else 0.0
    )
