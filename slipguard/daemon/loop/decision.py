"""What one cycle of the loop decided, for observers, and how fast the cycles are."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from slipguard.control.control_step import ControlState
from slipguard.control.messages import Observation, StepOutput
from slipguard.control.state import Phase
from slipguard.perception.estimate import Estimate

LATENCIES_KEPT = 2000
"""The last 15 to 30 s."""
RATE_WINDOW_S = 2.0
"""Frame rates are averages over this time."""


@dataclass(frozen=True, slots=True)
class Decision:
    """One cycle of the loop.

    state_before: the controller's state before the cycle. estimates: by finger, the fresh estimate, or None.
    new_estimates: those that this cycle was the first to use. latencies_s: of each of them, from receiving the frame
    until no command was found necessary; empty if there was one (see `Service.hold_observers`).
    """

    now_s: float
    phase: Phase
    observation: Observation
    output: StepOutput
    state_before: ControlState
    estimates: Mapping[str, Estimate | None] = field(default_factory=dict)
    new_estimates: Mapping[str, Estimate] = field(default_factory=dict)
    latencies_s: tuple[float, ...] = ()


class LatencyStats:
    """Observes a service: each finger's frame rate, and the latency from a frame to its decision.

    latencies_s: the newest, from receiving a frame until its command was sent or found unnecessary.
    """

    def __init__(self, fingers: Iterable[str]) -> None:
        self.latencies_s: deque[float] = deque(maxlen=LATENCIES_KEPT)
        self._estimated_s: dict[str, deque[float]] = {name: deque() for name in fingers}

    def add_decision(self, decision: Decision) -> None:
        """Add one cycle of the loop (for `Service.observers`)."""
        self.latencies_s.extend(decision.latencies_s)
        for name in decision.new_estimates:
            self._estimated_s[name].append(decision.now_s)
        for times_s in self._estimated_s.values():
            while times_s and times_s[0] < decision.now_s - RATE_WINDOW_S:
                times_s.popleft()

    def add_hold(self, latency_s: float) -> None:
        """Add a force command that was sent to the gripper (for `Service.hold_observers`)."""
        self.latencies_s.append(latency_s)

    @property
    def frames_per_s(self) -> Mapping[str, float]:
        """Estimates per second of each finger, over the last `RATE_WINDOW_S`."""
        return {name: len(times_s) / RATE_WINDOW_S for name, times_s in self._estimated_s.items()}
