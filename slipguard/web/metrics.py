"""The metrics as Prometheus reads them, made from the daemon's state and its tallies at each look.

A registry of its own: whatever else counts in this process is nobody's business.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from typing import Any

from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import (
    CounterMetricFamily,
    GaugeMetricFamily,
    HistogramMetricFamily,
    InfoMetricFamily,
    Metric,
)
from prometheus_client.registry import Collector

LOST_FRAMES = ("corrupt", "frozen", "stalled", "missed", "late")
"""Of a finger's counts: frames that told nothing, by what became of them."""


def exposition(state: bytes, tallies: bytes) -> bytes:
    """Prometheus text of a state and the tallies, both JSON objects as `Control` gives them."""
    registry = CollectorRegistry(auto_describe=False)
    registry.register(_Told(json.loads(state), json.loads(tallies)))
    return generate_latest(registry)


class _Told(Collector):
    def __init__(self, state: Mapping[str, Any], tallies: Mapping[str, Any]) -> None:
        self._state, self._tallies = state, tallies

    def collect(self) -> Iterator[Metric]:
        yield InfoMetricFamily("slipguard_build", "What runs here.", {"version": str(self._state["version"])})
        yield from self._grasp()
        yield from self._frames()
        yield from self._times()
        yield from self._health()

    def _grasp(self) -> Iterator[Metric]:
        state = self._state
        rotation, gripper = state.get("rotation") or {}, state.get("gripper") or {}
        yield _gauge(
            "slipguard_rotation_degrees",
            "Rotation since the grasp, with the sign of the left image.",
            rotation.get("rotation_deg"),
        )
        yield _gauge(
            "slipguard_rotation_sigma_degrees", "One standard deviation of the rotation.", rotation.get("sigma_deg")
        )
        yield _gauge("slipguard_force_newtons", "Force last applied, per finger.", gripper.get("force_n"))
        yield _gauge("slipguard_target_force_newtons", "Force wanted, per finger.", state.get("target_force_n"))
        yield _gauge("slipguard_jaws_millimetres", "Width between the jaws.", gripper.get("width_mm"))
        for name, what in (("guarding", "Acts on slip."), ("slipping", "Something slips now.")):
            yield _gauge(f"slipguard_{name}", what, float(bool(state.get(name))))
        phase = GaugeMetricFamily("slipguard_phase", "1 for the phase the grasp is in.", labels=["phase"])
        phase.add_metric([str(state["phase"])], 1.0)
        yield phase
        faults = CounterMetricFamily("slipguard_faults", "Faults latched since the start.", labels=["code"])
        for code, count in self._tallies.get("faults", {}).items():
            faults.add_metric([code], count)
        yield faults
        yield _gauge("slipguard_fault", "1 while a fault is latched.", float(state.get("fault") is not None))

    def _frames(self) -> Iterator[Metric]:
        frames = CounterMetricFamily("slipguard_frames", "Good frames.", labels=["finger"])
        lost = CounterMetricFamily("slipguard_frames_lost", "Frames that told nothing.", labels=["finger", "reason"])
        skipped = CounterMetricFamily(
            "slipguard_frames_skipped", "Frames answered without the network.", labels=["finger", "reason"]
        )
        for finger, told in self._state.get("fingers", {}).items():
            counts = told.get("counts", {})
            frames.add_metric([finger], counts.get("frames", 0))
            for reason in LOST_FRAMES:
                lost.add_metric([finger, reason], counts.get(reason, 0))
            for reason, count in counts.get("skipped", {}).items():
                skipped.add_metric([finger, reason], count)
        yield from (frames, lost, skipped)
        yield CounterMetricFamily(
            "slipguard_deadlines_missed", "Beats of the loop that were missed.", value=self._state["deadlines_missed"]
        )

    def _times(self) -> Iterator[Metric]:
        edges_ms = self._tallies.get("edges_ms", [])
        stages = HistogramMetricFamily(
            "slipguard_stage_seconds", "Time that one stage took for one frame.", labels=["finger", "stage"]
        )
        for finger, told in self._tallies.get("stages", {}).items():
            for stage, histogram in told.items():
                stages.add_metric([finger, stage], *_buckets(edges_ms, histogram))
        yield stages
        for name, what in (
            ("reaction", "From a frame's being handed over until no command was found needed."),
            ("hold", "From a frame's being handed over until its command goes to the gripper."),
        ):
            family = HistogramMetricFamily(f"slipguard_{name}_seconds", what, labels=[])
            if name in self._tallies:
                family.add_metric([], *_buckets(edges_ms, self._tallies[name]))
            yield family

    def _health(self) -> Iterator[Metric]:
        ready = GaugeMetricFamily("slipguard_device_ready", "1 after a good answer.", labels=["device"])
        for name, told in self._state.get("devices", {}).items():
            ready.add_metric([name], float(told.get("state") == "ready"))
        yield ready
        answers = CounterMetricFamily(
            "slipguard_device_answers", "Answers to a question for the state.", labels=["device"]
        )
        for name, count in self._tallies.get("devices_answered", {}).items():
            answers.add_metric([name], count)
        yield answers
        recording = self._state.get("recording") or {}
        yield _gauge("slipguard_recording", "1 while it is recorded.", float(recording.get("state") == "on"))
        yield CounterMetricFamily(
            "slipguard_recording_left_out", "Values that found no room.", value=recording.get("left_out", 0)
        )


def _gauge(name: str, what: str, value: float | None) -> Metric:
    """A number; no sample where it is not known."""
    family = GaugeMetricFamily(name, what, labels=[])
    if value is not None:
        family.add_metric([], float(value))
    return family


def _buckets(edges_ms: list[float], histogram: Mapping[str, Any]) -> tuple[list[tuple[str, float]], float]:
    """Cumulative buckets by their upper edge in seconds, and the sum in seconds."""
    buckets, below = [], 0
    for edge, count in zip([*(f"{edge / 1e3:g}" for edge in edges_ms), "+Inf"], histogram["counts"], strict=True):
        below += count
        buckets.append((edge, float(below)))
    return buckets, histogram["sum_ms"] / 1e3
