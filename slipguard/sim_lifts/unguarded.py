"""The law with its eyes shut: grips, lifts and lowers the same way, and never sees a turn."""

from __future__ import annotations

from dataclasses import replace

from slipguard.control.controller import step
from slipguard.control.guard import Guard
from slipguard.control.messages import Command, Seen
from slipguard.control.params import GuardParams


def unguarded_tick(guard: Guard, seen: Seen, params: GuardParams) -> tuple[Guard, Command]:
    """What `tick` does with an object that seems never to move: the same phases, the first force throughout."""
    fused = seen.fused
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
    eyes_shut = params.model_copy(update={"blind_force_n": params.first_force_n})
    law, command = step(guard.law, replace(seen, fused=fused, fault=None), eyes_shut)
    return replace(guard, law=law), command
