"""The record of one simulated lift, with truth and estimates, and the figures of a campaign."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from slipguard.devices import FINGERS
from slipguard.perception.estimate import Estimate
from slipguard.sim.world import WorldTruth
from slipguard.tools.figures import Figures, percentiles_ms, rounded

IMAGE_SIGN = {"left": 1.0, "right": -1.0}
"""A rotation that is counter-clockwise in the left image is clockwise in the right image."""

MIN_ROTATION_DEG = 10.0
"""Rotation errors are computed for lifts whose true rotation reached this."""


@dataclass(frozen=True, slots=True)
class EstimatedRotation:
    """One estimate. rotation_deg: in the left image. captured_at_s: capture time of its frame."""

    captured_at_s: float
    rotation_deg: float
    sigma_deg: float


@dataclass(slots=True)
class LiftRecord:
    """One lift, filled while it runs."""

    object_name: str
    hard: str = ""
    truth: list[WorldTruth] = field(default_factory=list)
    estimates: dict[str, list[Estimate]] = field(default_factory=lambda: {name: [] for name in FINGERS})
    fused: list[EstimatedRotation] = field(default_factory=list)
    latency_s: list[float] = field(default_factory=list)
    deadlines_missed: int = 0
    outcome: str = "held"
    why: str = ""
    ended_at_s: float = float("inf")
    """When the object was dropped or put down; frames captured later do not count."""

    @property
    def true_rotation_deg(self) -> float:
        """Largest true rotation since the grip, in degrees, with the sign of the left image."""
        rotations = np.array([now.rotation_deg for now in self.truth if now.time_s <= self.ended_at_s])
        if rotations.size == 0:
            return 0.0
        since = rotations - rotations[0]
        return float(since[np.argmax(np.abs(since))])

    @property
    def true_slip_deg(self) -> float:
        """The part of the rotation at the end that is slip: the rest is elastic torsion of the gels, which returns."""
        slips = [now.slip_deg for now in self.truth if now.time_s <= self.ended_at_s]
        return slips[-1] - slips[0] if slips else 0.0

    def measured(self, finger: str) -> list[EstimatedRotation]:
        """Return the estimates of one finger with the sign of the left image."""
        return [
            EstimatedRotation(estimate.captured_at_s, IMAGE_SIGN[finger] * estimate.rotation_deg, estimate.sigma_deg)
            for estimate in self.estimates[finger]
            if estimate.rotation_deg is not None and estimate.sigma_deg is not None
        ]

    def errors_deg(self, estimated: list[EstimatedRotation]) -> NDArray[np.float64]:
        """Return estimated minus true rotation, both since the first estimate, for frames before the end."""
        estimated = [one for one in estimated if one.captured_at_s <= self.ended_at_s]
        if not estimated or not self.truth:
            return np.empty(0)
        when_s = np.array([one.captured_at_s for one in estimated])
        true_deg = np.interp(when_s, [now.time_s for now in self.truth], [now.rotation_deg for now in self.truth])
        estimated_deg = np.array([one.rotation_deg for one in estimated], np.float64)
        return np.asarray(estimated_deg - (true_deg - true_deg[0]), np.float64)

    @property
    def counts(self) -> bool:
        """Whether this lift counts for the rotation errors."""
        return abs(self.true_rotation_deg) >= MIN_ROTATION_DEG

    @property
    def skips(self) -> Counter[str]:
        """Skipped frames by reason, both fingers."""
        return Counter(
            estimate.skipped for name in FINGERS for estimate in self.estimates[name] if estimate.skipped is not None
        )

    @property
    def frames(self) -> int:
        """Number of processed frames, both fingers."""
        return sum(len(self.estimates[name]) for name in FINGERS)


@dataclass(frozen=True, slots=True)
class SourceRotationErrors:
    """Rotation errors of one source (a finger, or both fused) over all lifts that count."""

    source: str
    lifts: int = 0
    mean_deg: float | None = None
    p95_deg: float | None = None
    worst_object_deg: float | None = None
    worst_object: str | None = None


def rotation_errors(records: list[LiftRecord], source: str) -> SourceRotationErrors:
    """Return the errors of `source`: "left", "right" or "fused"."""
    per_object: dict[str, list[NDArray[np.float64]]] = {}
    for record in records:
        errors = np.abs(record.errors_deg(record.fused if source == "fused" else record.measured(source)))
        if record.counts and errors.size:
            per_object.setdefault(record.object_name, []).append(errors)
    if not per_object:
        return SourceRotationErrors(source)
    means = {name: float(np.mean(np.concatenate(parts))) for name, parts in per_object.items()}
    every = Figures.of(np.concatenate([part for parts in per_object.values() for part in parts]))
    worst = max(means, key=lambda name: means[name])
    lifts = sum(len(parts) for parts in per_object.values())
    return SourceRotationErrors(source, lifts, every.mean, every.p95, means[worst], worst)


def latency_figures(latencies_s: list[float], *, realtime: bool) -> dict[str, float | None]:
    """Return p50 and p99 under their public keys; None on a virtual clock, on which latencies mean nothing."""
    p50_ms, p99_ms = percentiles_ms(latencies_s) if realtime and latencies_s else (None, None)
    return {"latency_p50_ms": rounded(p50_ms, 2), "latency_p99_ms": rounded(p99_ms, 2)}


def summary(records: list[LiftRecord], *, realtime: bool) -> dict[str, object]:
    """Return the figures of a campaign under the keys of the public `--json` line."""
    fused = rotation_errors(records, "fused")
    rotations = np.abs([record.true_rotation_deg for record in records]) if records else np.empty(0)
    slips = np.abs([record.true_slip_deg for record in records]) if records else np.empty(0)
    frames = sum(record.frames for record in records)
    skipped = sum(sum(record.skips.values()) for record in records)
    outcomes = Counter(record.outcome for record in records)
    return {
        "lifts": len(records),
        "held": outcomes["held"],
        "dropped": outcomes["dropped"],
        "refused": outcomes["refused"],
        "turn_error_lifts": fused.lifts,
        "turn_error_mean_deg": rounded(fused.mean_deg, 3),
        "turn_error_worst_object_deg": rounded(fused.worst_object_deg, 3),
        "true_turn_median_deg": rounded(float(np.median(rotations)) if rotations.size else None, 2),
        "true_turn_max_deg": rounded(float(rotations.max()) if rotations.size else None, 2),
        "true_slip_median_deg": rounded(float(np.median(slips)) if slips.size else None, 2),
        "true_slip_max_deg": rounded(float(slips.max()) if slips.size else None, 2),
        "over_20_deg_or_dropped": sum(
            record.outcome == "dropped" or abs(record.true_rotation_deg) > 20.0 for record in records
        ),
        **latency_figures([value for record in records for value in record.latency_s], realtime=realtime),
        "skipped_share": rounded(skipped / frames if frames else 0.0, 4),
        "deadlines_missed": sum(record.deadlines_missed for record in records),
    }
