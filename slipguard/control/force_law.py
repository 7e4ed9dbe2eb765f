"""The force law: grip so that the load over capacity, one reaction time ahead, stays below 1 / margin.

    force = present force * (margin * lambda) ** (1 / (1 + gamma))

lambda is the load over the capacity (load_state.py) after the motion to expect until a tightening takes effect, at its
upper end. The force only rises while an object is held. A grip whose lambda stays below 1 / margin is left alone.

How far the load can grow within a reaction time is bounded: while slipguard lifts, the arm is slow until the object
hangs, and stops at each tightening, so by `ARRIVES`. An object that slips freely accelerates with what its load exceeds
the capacity: I alpha = tau - T. A bar held at its end, without friction, would have alpha = 3 g / (4 b). So lambda is
1 / (1 - alpha 4 b / (3 g)), with alpha = rate^2 / (2 theta); a slide is the same with g alone.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from slipguard.control import force_limits
from slipguard.control.contact_motion import ZERO
from slipguard.control.finger_fusion import FusedEstimate
from slipguard.control.load_state import CAPACITY_EXPONENT, STIFFNESS_PRIOR, LoadState, deg_per_mm
from slipguard.control.messages import Observation
from slipguard.control.params import GuardParams
from slipguard.control.reports import Fault, FaultCode, Message, Text
from slipguard.control.state import GraspState, Phase, SlipEpisode, gripper_at_rest
from slipguard.limit_surface import GRAVITY_M_S2

UPPER = 0.7
"""The upper end of lambda: this quantile."""
SURELY = 0.9
"""Quantile of the elastic limit beyond which a motion is slip for certain."""
ARRIVES = 1.25
"""A load that arrives grows by no more than this within a reaction time."""
SLIPS_MOST = 2.0
"""The largest lambda that a rate shows: a gel that swings elastically rotates as fast at first."""
FREE = 1.1
"""From this lambda on, a rate shows free slip even while the imprint grows with the force."""
STEP = 1.3
"""A tightening goes at least this far: each one costs a stop of the arm, and a stop and a go of the jaws."""
LEVER_MM = 60.0
"""Where no lever is given."""
LEAST_DEG = 0.3
"""Rotation from which a rate shows an acceleration."""
ARM_STOPS_S = 0.05
"""An arm that slipguard moves slowly stands this long after the command."""
IMPRINT_S = 0.03
"""The imprint has taken its new shape this long after the jaws have come to rest."""
EFFECT_S = 0.05
"""A rate shows the effect of a tightening this much later."""
CALM_S = 0.1
"""Slip is over when nothing has moved for this time."""
BEYOND_LIMIT_DEG = 5.0
"""At the force limit, this much motion beyond the elastic one is slip that no force answers."""
UNSETTLED_S = 5.0
"""Slip that has neither settled nor been answered for this time never will: something shakes the object."""
DELAY_MAX_S = 0.5
"""A longer delay of the gripper is not waited for."""
FAR_FRAMES = 2
"""An object has rotated too far if this many frames in a row show it: one may be wrong."""


@dataclass(frozen=True, slots=True)
class Guarding:
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


def guard(state: GraspState, observation: Observation, params: GuardParams) -> Guarding:
    """Return the state after the newest estimate of a held object, and the force that its load needs."""
    fused, slip, load = observation.fused, state.held.slip, state.held.load
    if fused is None or not state.guarding:
        return Guarding(state, stop_arm=slip is not None)
    if not load.weights:
        load = load.started(STIFFNESS_PRIOR, state.grip.target_n)
    if not _at_rest(state, observation):
        load = replace(load, jaws_moved_s=observation.now_s)
    state = _with_load(state, load)
    if fused.measured_at_s <= load.motion.measured_s:
        return _settle(state, observation, params)
    return _follow(state, fused, observation, params)


def _follow(state: GraspState, fused: FusedEstimate, observation: Observation, params: GuardParams) -> Guarding:
    """Return what follows from a new estimate."""
    arm, load = observation.arm, state.held.load
    lowers = state.phase is Phase.LOWERING or state.arm.putting_down
    load = load.set_down() if lowers else load
    lifts = state.phase is Phase.LIFTING and not load.hangs
    settled = _at_rest(state, observation) and fused.captured_at_s >= load.jaws_moved_s + IMPRINT_S
    load = load.gripped(state.grip.target_n) if settled else replace(load, level_mm=math.inf)
    rests = arm is not None and not arm.moving and state.held.slip is None
    motion, moved = load.motion.followed(fused, rests=rests, settled=settled, sure=lifts)
    if fused.slides and settled and not lowers:  # by an unknown distance: slip
        moved = (moved[0], load.elastic_limit_deg(1.0) / deg_per_mm(load.force_n), moved[2])
    load = replace(load, motion=motion).moved(moved, put_down=lowers)
    if arm is not None:  # where it was when this frame was captured
        rose_mm = arm.speed_mm_s * (observation.now_s - fused.captured_at_s) if state.phase is Phase.LIFTING else 0.0
        load = load.risen(arm.height_mm - rose_mm)
    free = _free_slip(load, fused, params)
    moves = any(moved) or (not settled and not lowers and free > FREE)
    ahead_s = observation.now_s - fused.captured_at_s + _reaction_s(state, observation, params)
    soon = motion.soon(ahead_s)
    load = replace(load, object_moved_s=observation.now_s if any(soon) else load.object_moved_s)
    load = _at_limit(load, state, observation, params, settled=settled)
    load = replace(load, far_frames=load.far_frames + 1 if _rotated_far(fused, params) else 0)
    state = _with_load(state, load)
    if state.held.referenced and load.far_frames >= FAR_FRAMES:
        return _give_up(state, observation, params)
    moves = moves or (lifts and any(soon))
    upper = load.over_capacity(UPPER, soon if moves and not lowers else ZERO, max(free, ARRIVES)) if settled else free
    needed_n = load.force_n * (params.margin * upper) ** (1.0 / CAPACITY_EXPONENT)
    if moves and needed_n > state.grip.target_n:
        return _tighten(state, upper, needed_n, observation, params)
    return _settle(state, observation, params)


def _tighten(
    state: GraspState, upper: float, needed_n: float, observation: Observation, params: GuardParams
) -> Guarding:
    """Tighten to the needed force, by `STEP` at least and up to the force limit; stop the arm meanwhile."""
    now_s, present_n, what = observation.now_s, state.grip.target_n, _what(state, upper)
    force_range = force_limits.present_range(params, observation)
    target_n = present_n
    if force_range is not None:
        modelled_n = params.modelled_n(state.held.pad) or 0.0
        target_n = force_range.raised(present_n, max(needed_n, STEP * present_n, modelled_n))
    lifts_off = state.phase is Phase.LIFTING and not state.held.load.hangs
    held = lifts_off or upper < 1.0
    if target_n <= present_n and state.held.slip is None and held and not _beyond_limit(state.held.load):
        return Guarding(state)  # a stop of the arm gains nothing
    slip = state.held.slip or SlipEpisode(now_s, now_s)
    state = replace(state, held=replace(state.held, slip=slip))
    if _no_force(state, observation):
        return Guarding(state, stop_arm=True)
    if target_n > present_n:
        state = replace(state, held=replace(state.held, slip=replace(slip, tightened_s=now_s)))
        load = replace(state.held.load, tightened=True, jaws_moved_s=now_s)
        message = Text.TIGHTENING.message(what=what, from_n=present_n, to_n=target_n)
        return Guarding(_with_load(state.with_target(target_n, now_s), load), target_n, stop_arm=True, message=message)
    if _beyond_limit(state.held.load):
        return Guarding(state, stop_arm=True, fault=_limit_reached(state, what, params))
    if slip.began_s < now_s:
        return _settle(state, observation, params)
    return Guarding(state, stop_arm=True, message=Text.AT_FORCE_LIMIT.message(what=what, force_n=present_n))


def _settle(state: GraspState, observation: Observation, params: GuardParams) -> Guarding:
    """End the slip once a tightening has shown its effect and nothing moves."""
    slip, load, now_s = state.held.slip, state.held.load, observation.now_s
    if slip is None:
        return Guarding(state)
    shown = load.motion.captured_s >= slip.tightened_s + _delay_s(state, params) + EFFECT_S
    if shown and now_s - load.object_moved_s >= CALM_S and _at_rest(state, observation):
        state = replace(state, held=replace(state.held, slip=None))
        return Guarding(state, message=Text.SETTLED.message(force_n=state.grip.target_n))
    if now_s - slip.tightened_s >= UNSETTLED_S:
        return Guarding(state, stop_arm=True, fault=_never_settled(state))
    return Guarding(state, stop_arm=True)


def _free_slip(load: LoadState, fused: FusedEstimate, params: GuardParams) -> float:
    """Return the load over the capacity that the acceleration of a free slip shows, at least 1."""
    motion, per_mm = load.motion, deg_per_mm(load.force_n)
    rate_deg_s = motion.speed[0] if fused.rate_deg_s is None else fused.rate_deg_s
    rad_s2 = math.radians(rate_deg_s**2 / (2.0 * max(abs(motion.position[0]), LEAST_DEG)))
    slide_mm, slide_mm_s = math.hypot(*motion.position[1:]), math.hypot(*motion.speed[1:])
    m_s2 = 1e-3 * slide_mm_s**2 / (2.0 * max(slide_mm, LEAST_DEG / per_mm))
    share = max(rad_s2 * 1e-3 * (params.lever_mm or LEVER_MM) / (0.75 * GRAVITY_M_S2), m_s2 / GRAVITY_M_S2)
    return 1.0 / max(1.0 - share, 1.0 / SLIPS_MOST)


def _reaction_s(state: GraspState, observation: Observation, params: GuardParams) -> float:
    """Return the time until a reaction takes effect: of the arm, if it is the arm that brings the load."""
    arm, delay_s = observation.arm, _delay_s(state, params)
    lifts = state.phase is Phase.LIFTING and arm is not None and arm.moving
    return min(ARM_STOPS_S, delay_s) if lifts else delay_s


def _delay_s(state: GraspState, params: GuardParams) -> float:
    """Return the time from a command to the gripper until it takes effect."""
    delay_s = state.grip.delay.delay_s
    return params.tuning.tighten_delay_s if delay_s is None else min(delay_s, DELAY_MAX_S)


def _at_limit(
    load: LoadState, state: GraspState, observation: Observation, params: GuardParams, *, settled: bool
) -> LoadState:
    """Return the load with the position at which the gripper first held with the force limit."""
    force_range = force_limits.present_range(params, observation)
    if force_range is not None and state.grip.target_n < force_range.high_n:
        return replace(load, at_limit=None)
    return replace(load, at_limit=load.motion.position) if load.at_limit is None and settled else load


def _beyond_limit(load: LoadState) -> bool:
    """Return whether the object has moved at the force limit by more than elastic motion."""
    if load.at_limit is None:
        return False
    deg, down_mm, side_mm = (a - b for a, b in zip(load.motion.position, load.at_limit, strict=True))
    per_mm = deg_per_mm(load.force_n)
    elastic_deg = load.elastic_limit_deg(SURELY) + load.motion.band[0]
    return math.hypot(deg, per_mm * down_mm, per_mm * side_mm) > BEYOND_LIMIT_DEG + elastic_deg


def _rotated_far(fused: FusedEstimate, params: GuardParams) -> bool:
    rotation_deg = abs(fused.rotation_deg or 0.0)
    return rotation_deg > params.tuning.rotation_max_deg and fused.conflict is None


def _with_load(state: GraspState, load: LoadState) -> GraspState:
    return replace(state, held=replace(state.held, load=load))


def _at_rest(state: GraspState, observation: Observation) -> bool:
    return observation.gripper is not None and gripper_at_rest(state, observation.gripper)


def _no_force(state: GraspState, observation: Observation) -> bool:
    """Return whether no force may be added: a person may be near, or the gels press on each other after a loss."""
    gripper = observation.gripper
    return state.person.forbids_force or (gripper is not None and gripper.closed_on_nothing)


def _what(state: GraspState, upper: float) -> str:
    """Return the motion and the load in words, with values."""
    position, rate = state.held.load.motion.position, state.held.load.motion.speed
    moved = f"rotated {abs(position[0]):.1f}° at {abs(rate[0]):.0f}°/s, moved {math.hypot(*position[1:]):.1f} mm"
    return f"the load is {upper:.2f} of what the grip holds ({moved})"


def _never_settled(state: GraspState) -> Fault:
    return Fault(
        FaultCode.NOT_SETTLED,
        f"not at rest for {UNSETTLED_S:g} s after slip at {state.grip.target_n:.0f} N",
        "find what shakes the object or the arm, then clear",
    )


def _limit_reached(state: GraspState, what: str, params: GuardParams) -> Fault:
    return Fault(
        FaultCode.FORCE_LIMIT_REACHED,
        f"{what} at {state.grip.target_n:.0f} N, and the force limit is {params.force_max_n:g} N",
        "support the object, lower it or release it; raise the force limit if object and gel allow it",
    )


def _give_up(state: GraspState, observation: Observation, params: GuardParams) -> Guarding:
    """Apply the force limit and report: the object is not being held."""
    force_range = force_limits.present_range(params, observation)
    present_n = target_n = state.grip.target_n
    if force_range is not None and not _no_force(state, observation):
        target_n = force_range.allowed(params.force_max_n, present_n)
    tightens = target_n > present_n
    force = f": tightening from {present_n:.0f} N to {target_n:.0f} N" if tightens else ""
    fault = Fault(
        FaultCode.ROTATED_TOO_FAR,
        f"rotated {observation.rotation_deg:.0f}° since it was gripped, at "
        f"{abs(state.held.load.motion.speed[0]):.0f}°/s{force}",
        "support the object and release it; grip it nearer to its center of mass",
    )
    if not tightens:
        return Guarding(state, stop_arm=True, fault=fault)
    return Guarding(state.with_target(target_n, observation.now_s), target_n, stop_arm=True, fault=fault)
