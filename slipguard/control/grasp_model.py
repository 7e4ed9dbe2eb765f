"""What the held object has shown of its friction and of the gel, and the force that follows from it.

The friction is learned from the torsion at the first slip, the stiffness of the gel from the torsion and shear of an
object that hangs at rest (needed_force.py).
"""

from __future__ import annotations

import math
from dataclasses import replace

from slipguard.control import needed_force
from slipguard.control.messages import Observation
from slipguard.control.needed_force import ElasticMotion, LogNormal, NeededForce
from slipguard.control.params import GuardParams
from slipguard.control.slip_detector import SlipAssessment
from slipguard.control.slip_memory import ArmCase
from slipguard.control.state import GraspState

REST_S = 0.5
"""An object at rest in the air for this time shows its elastic torsion."""


def elastic_limit(state: GraspState, params: GuardParams) -> ElasticMotion:
    """Return the elastic motion that the present grip bears without slip."""
    return needed_force.elastic_limit(state.grip.target_n, _friction(state, params), state.gel)


def force_for(state: GraspState, params: GuardParams, present_n: float, ratio: float, *, slides: bool) -> NeededForce:
    """Return the force for `ratio` times the load at which the object slips from `present_n`."""
    return needed_force.needed_force(
        present_n,
        ratio,
        slides=slides,
        friction=_friction(state, params),
        modelled_n=params.modelled_n(state.held.pad),
        pad=state.held.pad,
    )


def learn_from_slip(
    state: GraspState, seen: SlipAssessment, observation: Observation, params: GuardParams, slipping_n: float
) -> GraspState:
    """Return the state with what the torsion at the first slip says about the friction."""
    if state.held.first_n is None:
        state = replace(state, held=replace(state.held, first_n=slipping_n))
    if state.held.friction is not None or not seen.rotates or slipping_n <= 0.0:
        return state
    known = _friction(state, params), state.gel
    friction = needed_force.after_slip(slipping_n, observation.rotation_deg, *known)
    return replace(state, held=replace(state.held, friction=friction))


def learn_from_lift(
    state: GraspState, seen: SlipAssessment, observation: Observation, params: GuardParams
) -> GraspState:
    """Return the state with what the torsion of an object that has been lifted says about the gel."""
    context, from_deg, fused = seen.memory.arm, seen.memory.baselines.unloaded_deg, observation.fused
    rests = context.hangs and context.case is ArmCase.REST and seen.settled_s >= REST_S
    if state.held.gel_learned or not rests or not state.held.referenced or state.grip.target_n <= 0.0:
        return state
    rotation_deg = fused.rotation_deg if fused is not None else None
    if fused is None or rotation_deg is None or from_deg is None:
        return state
    from_mm = seen.memory.baselines.unloaded_mm
    shift_mm = (fused.shift_mm, fused.sideways_mm or 0.0) if fused.shift_mm is not None else (0.0, 0.0)
    since_mm = math.dist(shift_mm, from_mm) if fused.shift_mm is not None and from_mm is not None else 0.0
    since_grip = state.held.first_n or state.grip.target_n, ElasticMotion(abs(rotation_deg), math.hypot(*shift_mm))
    since_step = state.grip.target_n, ElasticMotion(abs(rotation_deg - from_deg), since_mm)
    gel = needed_force.after_lift(since_grip, since_step, _friction(state, params), state.gel)
    return replace(state, held=replace(state.held, gel_learned=True), gel=gel)


def _friction(state: GraspState, params: GuardParams) -> LogNormal:
    """Return what is known of the friction of the held object."""
    return state.held.friction or needed_force.friction_of(params.friction)
