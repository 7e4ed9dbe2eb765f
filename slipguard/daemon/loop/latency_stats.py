"""How fast the guard is: each finger's frame rate, and how long its answers wait for a decision."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping

from slipguard.daemon.loop.decision import Decision

KEPT = 2000
"""Latencies remembered: the last 15 to 30 s."""
OVER_S = 2.0
"""A frame rate is told over this time."""


class LatencyStats:
    """An observer of the service.

    latencies_s: the newest, from a frame's being handed over until its command went out or none was found needed.
    """

    def __init__(self, fingers: Iterable[str]) -> None:
        self.latencies_s: deque[float] = deque(maxlen=KEPT)
        self._answered_s: dict[str, deque[float]] = {name: deque() for name in fingers}

    def decided(self, decision: Decision) -> None:
        """Note one turn of the loop (`Service.observers`)."""
        self.latencies_s.extend(decision.latencies_s)
        for name in decision.new_estimates:
            self._answered_s[name].append(decision.now_s)
        for answered_s in self._answered_s.values():
            while answered_s and answered_s[0] < decision.now_s - OVER_S:
                answered_s.popleft()

    def held(self, latency_s: float) -> None:
        """Note a command on its way to the gripper (`Service.hold_observers`)."""
        self.latencies_s.append(latency_s)

    @property
    def frames_per_s(self) -> Mapping[str, float]:
        """Answers of each finger in a second, over the last `OVER_S`."""
        return {name: len(answered_s) / OVER_S for name, answered_s in self._answered_s.items()}
