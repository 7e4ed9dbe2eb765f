"""Counts and times for the metrics: kept as plain numbers while the loop runs, made into text by the web room.

An observation costs about a microsecond, and telling all of them a small JSON object.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import Counter
from functools import partial

from slipguard.daemon.loop.decision import Decision
from slipguard.daemon.loop.event_log import Event
from slipguard.daemon.loop.finger import ProcessedFrame
from slipguard.daemon.loop.service import Service

EDGES_MS = (0.05, 0.1, 0.25, 0.5, 1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 10.0, 15.0, 20.0, 30.0, 50.0, 100.0, 250.0)
"""Upper edges of the histograms; the last bucket is open."""


class Histogram:
    """How many times fell into which bucket, and their sum."""

    def __init__(self) -> None:
        self._counts = [0] * (len(EDGES_MS) + 1)
        self._sum_ms = 0.0

    def add(self, time_ms: float) -> None:
        """Count one time."""
        self._counts[bisect_left(EDGES_MS, time_ms)] += 1
        self._sum_ms += time_ms

    def as_dict(self) -> dict[str, object]:
        """counts: of each bucket, not cumulative."""
        return {"counts": list(self._counts), "sum_ms": self._sum_ms}


class LoopMetrics:
    """Listens to a service from now on."""

    def __init__(self, service: Service) -> None:
        self._service = service
        self._stages: dict[str, dict[str, Histogram]] = {name: {} for name in service.fingers}
        self._reaction = Histogram()
        self._hold = Histogram()
        self._faults: Counter[str] = Counter()
        for name, finger in service.fingers.items():
            finger.observers.append(partial(self._judged, name))
        service.observers.append(self._decided)
        service.hold_observers.append(lambda since_handed_s: self._hold.add(1e3 * since_handed_s))
        service.event_log.listeners.append(self._told)

    def _judged(self, finger: str, processed: ProcessedFrame) -> None:
        if processed.estimate is None:
            return
        stages = self._stages[finger]
        for stage, time_ms in processed.estimate.stage_ms.items():
            if stage not in stages:
                stages[stage] = Histogram()
            stages[stage].add(time_ms)

    def _decided(self, decision: Decision) -> None:
        for time_s in decision.latencies_s:
            self._reaction.add(1e3 * time_s)

    def _told(self, event: Event) -> None:
        if event.code is not None:
            self._faults[event.code] += 1

    def as_dict(self) -> dict[str, object]:
        """Everything, as JSON can say it; edges_ms belong to all histograms."""
        return {
            "edges_ms": EDGES_MS,
            "stages": {
                finger: {stage: histogram.as_dict() for stage, histogram in stages.items()}
                for finger, stages in self._stages.items()
            },
            "reaction": self._reaction.as_dict(),
            "hold": self._hold.as_dict(),
            "faults": dict(self._faults),
            "devices_answered": {
                "gripper": self._service.gripper.polled,
                "arm": self._service.arm.polled,
            },
        }
