"""What one turn of the loop decided, as observers are told it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from slipguard.control.messages import Command, Observation
from slipguard.control.state import Phase
from slipguard.control.step import ControlState
from slipguard.perception.estimate import Estimate


@dataclass(frozen=True, slots=True)
class Decision:
    """One turn of the loop.

    memory: the law's, before. estimates: by finger, what spoke for it; None where nothing fresh did.
    new_estimates: those not yet decided on. latencies_s: of each of them, from the frame's being handed over
    until no command was found needed; empty where one was (see `Service.hold_observers`).
    """

    now_s: float
    phase: Phase
    observation: Observation
    command: Command
    memory: ControlState
    estimates: Mapping[str, Estimate | None] = field(default_factory=dict)
    new_estimates: Mapping[str, Estimate] = field(default_factory=dict)
    latencies_s: tuple[float, ...] = ()
