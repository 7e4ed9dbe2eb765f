"""Results of a bench: one row per pipeline, the value of each skip, and the whole as a public JSON object."""

from __future__ import annotations

import math
import platform
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import onnxruntime as ort

PUBLISHED: dict[str, Any] = {
    "source": "Castaño-Amorós and Gil, Rotational Slippage Prediction from Segmentation of Tactile Images",
    "where": "real cell, as published; another machine, other objects, real slip",
    "network": "DeepLabV3+ with ResNet18",
    "network_ms_on_an_a100": 6.0,
    "turn_error_mean_deg": 1.854,
    "turn_error_sd_deg": 0.988,
    "turn_error_worst_object_deg": 3.0,
    "dice": 0.956,
    "iou": 0.914,
}
"""Stands apart from what was measured here: it cannot be compared figure by figure."""


@dataclass(frozen=True, slots=True)
class BenchRow:
    """One pipeline's figures; None where unknown or not asked. Times in ms, of one frame in contact where not said.

    skipped_p50_ms: of frames left out, for want of contact or of change. turn errors: absolute, in degrees, over frames
    after the reference with an angle, of the objects of the test manifest; worst object: the largest mean of one;
    readable: of the objects that have an axis, the ones that the paper's way is meant for. declined_share: of such
    frames of objects with a readable axis, those without an angle. quartiles: means over the grasps from the easiest
    quarter to the hardest. within_n_sigma: share of errors no larger than n times the sigma stated; its _se: standard
    error, told by how much grasps differ, for the errors of one grasp are alike. round textured, round plain: objects
    without an axis, with and without texture; confident: a turn stated that is larger than three of its sigmas.
    mean_ms_per_frame_grasp, cpu_s_per_minute_grasp: over a minute of holding; of a large network with slipguard's
    estimators reckoned from its own frames and the share of frames that the default leaves out. stage_ms: stage ->
    (p50, p99) of the frames that needed it, and its mean over all. pareto: no other row is both faster (mean over the
    grasp) and more accurate. frames, sequences: asked of a turn; turns, turn_sequences: those that the turn errors are
    taken over, without declined ones and without the two plain objects that are in no manifest.
    """

    name: str
    network: str
    estimator: str
    p50_ms: float | None
    p99_ms: float | None
    skipped_p50_ms: float | None
    turn_error_mean_deg: float | None
    turn_error_worst_object_deg: float | None
    declined_share: float | None
    dice: float | None
    iou: float | None
    frames: int
    sequences: int | None
    resolution: str | None = None
    skipping: bool = True
    threads: int = 1
    mean_ms_per_frame_grasp: float | None = None
    cpu_s_per_minute_grasp: float | None = None
    no_contact_p50_ms: float | None = None
    unchanged_p50_ms: float | None = None
    turn_error_readable_mean_deg: float | None = None
    turn_error_sd_deg: float | None = None
    turn_error_p95_deg: float | None = None
    turn_error_by_quartile_deg: tuple[float | None, ...] | None = None
    within_1_sigma: float | None = None
    within_2_sigma: float | None = None
    within_1_sigma_se: float | None = None
    within_2_sigma_se: float | None = None
    round_textured_error_mean_deg: float | None = None
    round_textured_declined_share: float | None = None
    round_plain_declined_share: float | None = None
    round_plain_confident_share: float | None = None
    stage_ms: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)
    pareto: bool = False
    turns: int | None = None
    turn_sequences: int | None = None


@dataclass(frozen=True, slots=True)
class SkipResult:
    """What one skip is worth. saved_ms: of each frame left out; by processor time where a minute is measured.

    saved_ms_per_frame_grasp: over a minute of holding.

    error_added_deg: mean turn error with it less that without. frames_later: slip seen later because of it, the most
    of all onsets tried; None where it cannot matter. kept: whether slipguard does it. how: what n was, and why.
    """

    name: str
    kept: bool
    saved_ms: float | None
    saved_ms_per_frame_grasp: float | None
    error_added_deg: float | None
    frames_later: int | None
    how: str


@dataclass(frozen=True, slots=True)
class ThinningResult:
    """One size of masks through this thinning and others. ratios: how many times longer the others take."""

    size: str
    masks: int
    ms: float
    others_ms: Mapping[str, float]
    ratios: Mapping[str, float]
    pixels_different_from_cv2: int


@dataclass(frozen=True, slots=True)
class BenchReport:
    """What `slipguard bench` found."""

    machine: dict[str, Any]
    pipelines: tuple[BenchRow, ...]
    peers: tuple[BenchRow, ...]
    default: str
    thinning: tuple[ThinningResult, ...] = ()
    skips: tuple[SkipResult, ...] = ()
    notes: tuple[str, ...] = ()

    def reference(self, resolution: str) -> BenchRow | None:
        """The paper's pipeline of this size that times are compared with: the first such network of the peers, on as
        many threads as it is quickest with. None where there is none.
        """
        theirs = [row for row in self.peers if row.estimator == "skeleton" and row.resolution == resolution]
        alike = [row for row in theirs if row.network == theirs[0].network and row.p50_ms is not None]
        return min(alike, key=lambda row: row.p50_ms or math.inf, default=None)

    @property
    def thinning_vs_cv2(self) -> float | None:
        """How many times faster than the installed OpenCV, at the size where that is least."""
        return min((one.ratios["cv2"] for one in self.thinning), default=None)

    def as_json(self) -> dict[str, Any]:
        """The public result; numbers rounded, what is not known null."""
        return {
            "machine": self.machine,
            "pipelines": [_plain(asdict(row)) for row in self.pipelines],
            "peers": [_plain(asdict(row)) for row in self.peers],
            "default": self.default,
            "thinning_vs_cv2": _plain(self.thinning_vs_cv2),
            "thinning": [_plain(asdict(one)) for one in self.thinning],
            "skips": [_plain(asdict(one)) for one in self.skips],
            "published": PUBLISHED,
            "notes": list(self.notes),
        }


def on_the_front(rows: Iterable[BenchRow]) -> set[str]:
    """Names of the rows that no other beats in both mean time over a grasp and mean turn error."""
    known = [
        (row.name, row.mean_ms_per_frame_grasp, row.turn_error_mean_deg)
        for row in rows
        if row.mean_ms_per_frame_grasp is not None and row.turn_error_mean_deg is not None
    ]
    return {
        name
        for name, ms, error in known
        if not any(ms2 <= ms and e2 <= error and (ms2 < ms or e2 < error) for _, ms2, e2 in known)
    }


def quantile(values: Iterable[float], share: float) -> float | None:
    """A quantile, None of nothing."""
    found = list(values)
    return float(np.quantile(found, share)) if found else None


def mean(values: Iterable[float]) -> float | None:
    """The mean, None of nothing."""
    found = list(values)
    return float(np.mean(found)) if found else None


def machine() -> dict[str, Any]:
    """What the figures were taken on."""
    model = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.is_file():
        lines = [line for line in info.read_text(errors="replace").splitlines() if line.startswith("model name")]
        model = lines[0].split(":", 1)[1].strip() if lines else model
    return {
        "processor": model,
        "system": f"{platform.system()} {platform.release()}",
        "python": platform.python_version(),
        "onnxruntime": ort.__version__,
        "opencv": cv2.__version__,
        "threads": 1,
    }


def _plain(value: Any) -> Any:
    """For JSON: no NaN, no more digits than were measured, no tuples."""
    if isinstance(value, float):
        return round(value, 4) if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {key: _plain(one) for key, one in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(one) for one in value]
    return value
