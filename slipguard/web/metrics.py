"""Metrics in the format of Prometheus, made from the daemon's state and counters at each request."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
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

from slipguard.daemon.api.state import State

LOST_FRAMES = ("corrupt", "torn", "frozen", "stalled", "missed", "late")
"""Reasons of lost frames: these counts of a finger together."""


def prometheus_text(state: bytes, counters: bytes) -> bytes:
    """Return the metrics as text. state, counters: JSON as `DaemonApi` returns them."""
    registry = CollectorRegistry(auto_describe=False)
    registry.register(_StateCollector(State.model_validate_json(state), json.loads(counters)))
    return generate_latest(registry)


class _StateCollector(Collector):
    def __init__(self, state: State, counters: Mapping[str, Any]) -> None:
        self._state, self._counters = state, counters

    def collect(self) -> Iterator[Metric]:
        yield InfoMetricFamily("slipguard_build", "The running version.", {"version": self._state.version})
        yield from self._grasp()
        yield from self._frames()
        yield from self._times()
        yield from self._health()

    def _grasp(self) -> Iterator[Metric]:
        state, rotation, gripper = self._state, self._state.rotation, self._state.gripper
        for name, what, value in (
            (
                "rotation_degrees",
                "Rotation since the grasp, with the sign of the left image.",
                rotation.rotation_deg if rotation else None,
            ),
            (
                "rotation_sigma_degrees",
                "One standard deviation of the rotation.",
                rotation.sigma_deg if rotation else None,
            ),
            ("force_newtons", "Force applied last, per finger.", gripper.force_n if gripper else None),
            ("target_force_newtons", "Target force, per finger.", state.target_force_n),
            ("jaws_millimetres", "Width between the jaws.", gripper.width_mm if gripper else None),
            ("guarding", "1 while the guard acts on slip.", state.guarding),
            ("slipping", "1 while the object slips.", state.slipping),
            ("fault", "1 while a fault is latched.", state.fault is not None),
            ("recording", "1 while recording.", state.recording.state == "on"),
        ):
            yield _labeled(GaugeMetricFamily, name, what, (), {} if value is None else {(): float(value)})
        yield _labeled(GaugeMetricFamily, "phase", "1 for the present phase.", ("phase",), {(state.phase.value,): 1})
        faults = {(code,): count for code, count in self._counters.get("faults", {}).items()}
        yield _labeled(CounterMetricFamily, "faults", "Faults latched since the start.", ("code",), faults)

    def _frames(self) -> Iterator[Metric]:
        counts = {name: finger.counts for name, finger in self._state.fingers.items()}
        frames = {(name,): one.frames for name, one in counts.items()}
        restarts = {(name,): one.restarts for name, one in counts.items()}
        lost = {(name, reason): getattr(one, reason) for name, one in counts.items() for reason in LOST_FRAMES}
        skipped = {(name, reason): count for name, one in counts.items() for reason, count in one.skipped.items()}
        for metric, what, labels, values in (
            ("frames", "Good frames.", ("finger",), frames),
            ("frames_lost", "Lost frames, by reason.", ("finger", "reason"), lost),
            ("stream_restarts", "Restarts of a camera's stream because of torn frames.", ("finger",), restarts),
            ("frames_skipped", "Frames for which the network did not run.", ("finger", "reason"), skipped),
        ):
            yield _labeled(CounterMetricFamily, metric, what, labels, values)

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
        ready = {(name,): float(device.ready) for name, device in self._state.devices.items()}
        yield _labeled(GaugeMetricFamily, "device_ready", "1 if the last response was good.", ("device",), ready)
        answers = {(name,): count for name, count in self._counters.get("devices_answered", {}).items()}
        yield _labeled(
            CounterMetricFamily, "device_answers", "Responses to requests for the state.", ("device",), answers
        )
        for name, what, value in (
            ("deadlines_missed", "Cycles of the loop that started too late.", self._state.deadlines_missed),
            (
                "recording_left_out",
                "Values that were not recorded because the buffer was full.",
                self._state.recording.left_out,
            ),
            (
                "observer_errors",
                "Exceptions in recorder, metrics and other observers, without which the guard went on.",
                self._counters.get("observer_errors", 0),
            ),
            (
                "log_lines_lost",
                "Lines that were not logged because the terminal or journal was blocked.",
                self._counters.get("log_lines_lost", 0),
            ),
        ):
            yield _labeled(CounterMetricFamily, name, what, (), {(): value})


def _labeled(
    family: type[GaugeMetricFamily | CounterMetricFamily],
    name: str,
    what: str,
    labels: Sequence[str],
    values: Mapping[Any, float],
) -> Metric:
    """Return a metric with one sample for each tuple of label values; without a sample its value is unknown."""
    metric = family(f"slipguard_{name}", what, labels=labels)
    for label_values, value in values.items():
        metric.add_metric(label_values, value)
    return metric


def _buckets(edges_ms: list[float], histogram: Mapping[str, Any]) -> tuple[list[tuple[str, float]], float]:
    """Return cumulative buckets by upper edge in seconds, and the sum in seconds."""
    buckets, below = [], 0
    for edge, count in zip([*(f"{edge / 1e3:g}" for edge in edges_ms), "+Inf"], histogram["counts"], strict=True):
        below += count
        buckets.append((edge, float(below)))
    return buckets, histogram["sum_ms"] / 1e3
