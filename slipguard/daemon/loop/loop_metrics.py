"""Counters and histograms for the metrics; the web process formats them.

Adding a value takes about a microsecond, and reading all of them gives a small JSON object.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import Counter
from functools import partial

from slipguard.daemon.log_setup import lost_lines
from slipguard.daemon.loop.decision import Decision
from slipguard.daemon.loop.event_log import Event
from slipguard.daemon.loop.finger import ProcessedFrame
from slipguard.daemon.loop.service import Service

EDGES_MS = (0.05, 0.1, 0.25, 0.5, 1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 10.0, 15.0, 20.0, 30.0, 50.0, 100.0, 250.0)
"""Upper edges of the histograms; the last bucket is open."""


class Histogram:
    """Counts times by bucket, and sums them."""

    def __init__(self) -> None:
        self._counts = [0] * (len(EDGES_MS) + 1)
        self._sum_ms = 0.0

    def add(self, time_ms: float) -> None:
        """Add one time."""
        self._counts[bisect_left(EDGES_MS, time_ms)] += 1
        self._sum_ms += time_ms

    def as_dict(self) -> dict[str, object]:
        """Return the count of each bucket, not cumulative, and the sum."""
        return {"counts": list(self._counts), "sum_ms": self._sum_ms}


class LoopMetrics:
    """Observes a service from its construction on."""

    def __init__(self, service: Service) -> None:
        self._service = service
        self._stages: dict[str, dict[str, Histogram]] = {name: {} for name in service.fingers}
        self._reaction = Histogram()
        self._hold = Histogram()
        self._faults: Counter[str] = Counter()
        for name, finger in service.fingers.items():
            finger.observers.append(partial(self._add_frame, name))
        service.observers.append(self._add_decision)
        service.hold_observers.append(lambda latency_s: self._hold.add(1e3 * latency_s))
        service.event_log.listeners.append(self._add_event)

    def _add_frame(self, finger: str, processed: ProcessedFrame) -> None:
        if processed.estimate is None:
            return
        stages = self._stages[finger]
        for stage, time_ms in processed.estimate.stage_ms.items():
            if stage not in stages:
                stages[stage] = Histogram()
            stages[stage].add(time_ms)

    def _add_decision(self, decision: Decision) -> None:
        for time_s in decision.latencies_s:
            self._reaction.add(1e3 * time_s)

    def _add_event(self, event: Event) -> None:
        if event.code is not None:
            self._faults[event.code] += 1

    def as_dict(self) -> dict[str, object]:
        """Return everything as JSON; edges_ms belong to all histograms."""
        return {
            "edges_ms": EDGES_MS,
            "stages": {
                finger: {stage: histogram.as_dict() for stage, histogram in stages.items()}
                for finger, stages in self._stages.items()
            },
            "reaction": self._reaction.as_dict(),
            "hold": self._hold.as_dict(),
            "faults": dict(self._faults),
            "devices_answered": {"gripper": self._service.gripper.polled, "arm": self._service.arm.polled},
            "observer_errors": self._service.observer_errors,
            "log_lines_lost": lost_lines(),
        }
