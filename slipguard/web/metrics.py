"""Metrics in the format of Prometheus, made from the daemon's state and counters at each request."""

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

LOST_FRAMES = ("corrupt", "torn", "frozen", "stalled", "missed", "late")
"""Reasons of lost frames: these counts of a finger together."""


def prometheus_text(state: bytes, counters: bytes) -> bytes:
    """Return the metrics as text. state, counters: JSON objects as `DaemonApi` returns them."""
    registry = CollectorRegistry(auto_describe=False)
    registry.register(_StateCollector(json.loads(state), json.loads(counters)))
    return generate_latest(registry)


class _StateCollector(Collector):
    def __init__(self, state: Mapping[str, Any], counters: Mapping[str, Any]) -> None:
        self._state, self._counters = state, counters

    def collect(self) -> Iterator[Metric]:
        yield InfoMetricFamily("slipguard_build", "The running version.", {"version": str(self._state["version"])})
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
        yield _gauge("slipguard_force_newtons", "Force applied last, per finger.", gripper.get("force_n"))
        yield _gauge("slipguard_target_force_newtons", "Target force, per finger.", state.get("target_force_n"))
        yield _gauge("slipguard_jaws_millimetres", "Width between the jaws.", gripper.get("width_mm"))
        for name, description in (
            ("guarding", "1 while the guard acts on slip."),
            ("slipping", "1 while the object slips."),
        ):
            yield _gauge(f"slipguard_{name}", description, float(bool(state.get(name))))
        phase = GaugeMetricFamily("slipguard_phase", "1 for the present phase.", labels=["phase"])
        phase.add_metric([str(state["phase"])], 1.0)
        yield phase
        faults = CounterMetricFamily("slipguard_faults", "Faults latched since the start.", labels=["code"])
        for code, count in self._counters.get("faults", {}).items():
            faults.add_metric([code], count)
        yield faults
        yield _gauge("slipguard_fault", "1 while a fault is latched.", float(state.get("fault") is not None))

    def _frames(self) -> Iterator[Metric]:
        frames = CounterMetricFamily("slipguard_frames", "Good frames.", labels=["finger"])
        lost = CounterMetricFamily("slipguard_frames_lost", "Lost frames, by reason.", labels=["finger", "reason"])
        restarts = CounterMetricFamily(
            "slipguard_stream_restarts", "Restarts of a camera's stream because of torn frames.", labels=["finger"]
        )
        skipped = CounterMetricFamily(
            "slipguard_frames_skipped", "Frames for which the network did not run.", labels=["finger", "reason"]
        )
        for finger, state in self._state.get("fingers", {}).items():
            counts = state.get("counts", {})
            frames.add_metric([finger], counts.get("frames", 0))
            restarts.add_metric([finger], counts.get("restarts", 0))
            for reason in LOST_FRAMES:
                lost.add_metric([finger, reason], counts.get(reason, 0))
            for reason, count in counts.get("skipped", {}).items():
                skipped.add_metric([finger, reason], count)
        yield from (frames, lost, restarts, skipped)
        yield CounterMetricFamily(
            "slipguard_deadlines_missed",
            "Cycles of the loop that started too late.",
            value=self._state["deadlines_missed"],
        )

    def _times(self) -> Iterator[Metric]:
        edges_ms = self._counters.get("edges_ms", [])
        stages = HistogramMetricFamily(
            "slipguard_stage_seconds", "Time that one stage took for one frame.", labels=["finger", "stage"]
        )
        for finger, histograms in self._counters.get("stages", {}).items():
            for stage, histogram in histograms.items():
                stages.add_metric([finger, stage], *_buckets(edges_ms, histogram))
        yield stages
        for name, description in (
            ("reaction", "From a frame's arrival to the end of the control step that used it, if it sent no command."),
            ("hold", "From a frame's arrival until its command was sent to the gripper."),
        ):
            family = HistogramMetricFamily(f"slipguard_{name}_seconds", description, labels=[])
            if name in self._counters:
                family.add_metric([], *_buckets(edges_ms, self._counters[name]))
            yield family

    def _health(self) -> Iterator[Metric]:
        ready = GaugeMetricFamily("slipguard_device_ready", "1 if the last response was good.", labels=["device"])
        for name, device in self._state.get("devices", {}).items():
            ready.add_metric([name], float(device.get("state") == "ready"))
        yield ready
        responses = CounterMetricFamily(
            "slipguard_device_answers", "Responses to requests for the state.", labels=["device"]
        )
        for name, count in self._counters.get("devices_answered", {}).items():
            responses.add_metric([name], count)
        yield responses
        recording = self._state.get("recording") or {}
        yield _gauge("slipguard_recording", "1 while recording.", float(recording.get("state") == "on"))
        yield CounterMetricFamily(
            "slipguard_recording_left_out",
            "Values that were not recorded because the buffer was full.",
            value=recording.get("left_out", 0),
        )
        yield CounterMetricFamily(
            "slipguard_observer_errors",
            "Exceptions in recorder, metrics and other observers, without which the guard went on.",
            value=self._counters.get("observer_errors", 0),
        )
        yield CounterMetricFamily(
            "slipguard_log_lines_lost",
            "Lines that were not logged because the terminal or journal was blocked.",
            value=self._counters.get("log_lines_lost", 0),
        )


def _gauge(name: str, what: str, value: float | None) -> Metric:
    """Return a gauge; without a sample if the value is unknown."""
    family = GaugeMetricFamily(name, what, labels=[])
    if value is not None:
        family.add_metric([], float(value))
    return family


def _buckets(edges_ms: list[float], histogram: Mapping[str, Any]) -> tuple[list[tuple[str, float]], float]:
    """Return cumulative buckets by upper edge in seconds, and the sum in seconds."""
    buckets, below = [], 0
    for edge, count in zip([*(f"{edge / 1e3:g}" for edge in edges_ms), "+Inf"], histogram["counts"], strict=True):
        below += count
        buckets.append((edge, float(below)))
    return buckets, histogram["sum_ms"] / 1e3
