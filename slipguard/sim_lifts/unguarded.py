"""The law with its eyes shut: grips, lifts and lowers the same way, and never sees a turn."""

from __future__ import annotations

from dataclasses import replace

from slipguard.control.controller import step
from slipguard.control.messages import Command, Observation
from slipguard.control.params import GuardParams
from slipguard.control.step import ControlState


def unguarded_tick(state: ControlState, observation: Observation, params: GuardParams) -> tuple[ControlState, Command]:
    """What `tick` does with an object that seems never to move: the same phases, the first force throughout."""
    fused = observation.fused
    if fused is not None and (fused.left_contact or fused.right_contact):
        fused = replace(
            fused,
            rotation_deg=0.0,
            sigma_deg=1.0,
            rate_deg_s=0.0,
            shift_mm=0.0,
            fingers=("left", "right"),
            conflict=None,
            declined=None,
        )
    params = params.model_copy(update={"no_estimate_force_n": params.first_force_n})
    grasp, command = step(state.grasp, replace(observation, fused=fused, fault=None), params)
    return replace(state, grasp=grasp), command
