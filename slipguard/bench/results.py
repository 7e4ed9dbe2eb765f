"""Results of a bench: one row per pipeline, the value of each skip, and the whole as a public JSON object."""

from __future__ import annotations

import math
import platform
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import cv2
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
"""Published figures. They are not directly comparable with the measurements here."""


@dataclass(frozen=True, slots=True)
class BenchRow:
    """Figures of one pipeline; None if not measured. Times in ms, of a frame in contact unless stated otherwise.

    Attributes:
        skipped_p50_ms: Of skipped frames, without contact or unchanged.
        turn_error_mean_deg: Absolute rotation error over frames after the reference that are not declined, on the
            objects of the test manifest; also its sd, p95 and by quartile from the easiest grasps to the hardest.
        turn_error_worst_object_deg: The largest mean of one object.
        turn_error_readable_mean_deg: On the objects with an axis, for which the paper's pipeline is designed.
        declined_share: Share of declined frames on the objects with an axis.
        frames: Frames that are compared with the truth, in `sequences` grasps; `turns` of them in `turn_sequences`
            grasps have an error: not declined, and of an object of the test manifest.
        mean_ms_per_frame_grasp: Over a minute of holding, as is cpu_s_per_minute_grasp. For a large network with
            slipguard's estimators it is computed from its own times and the default's share of skipped frames.
        within_1_sigma: Share of errors up to one sigma; its _se: standard error from the variation between grasps,
            because errors within a grasp are correlated.
        round_textured_error_mean_deg: On objects without an axis but with texture.
        round_plain_confident_share: Share of estimates above three of their sigmas on objects without axis and texture.
        stage_ms: By stage: p50 and p99 of the frames with this stage, and its mean over all frames.
        pareto: No other row is both faster (mean over the grasp) and more accurate.
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
    """The value of one skip.

    Attributes:
        kept: Whether slipguard uses the skip.
        saved_ms: Time saved per skipped frame; processor time where a minute of holding is measured.
        saved_ms_per_frame_grasp: Time saved per frame of a minute of holding.
        error_added_deg: Mean rotation error with the skip minus without.
        frames_later: Longest delay of a slip's detection in frames; None where the skip cannot delay it.
        how: The number of frames measured.
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
    """Thinning times for one size of masks. ratios: times of other implementations relative to slipguard's."""

    size: str
    masks: int
    ms: float
    others_ms: Mapping[str, float]
    ratios: Mapping[str, float]
    pixels_different_from_cv2: int


@dataclass(frozen=True, slots=True)
class BaselineResult:
    """Errors of a baseline, degrees."""

    mean_deg: float | None
    worst_deg: float | None
    declined_share: float


@dataclass(frozen=True, slots=True)
class EffectResult:
    """Figures of one effect.

    Attributes:
        n: Frames that are compared with the truth. Shares below refer to those with an estimate.
        error_over_sigma_p99: 99th percentile.
        zero: Always answers 0.
        paper_axis: The paper's axis (thinning, line), on slipguard's own masks.
        shift_wrong_share: Share of reported shifts that are off by more than half of the finest pitch, 0.4 mm.
    """

    effect: str
    n: int
    grasps: int
    mean_deg: float | None
    worst_deg: float | None
    declined_share: float
    within_1_sigma: float | None
    within_2_sigma: float | None
    beyond_3_sigma: float | None
    beyond_4_sigma: float | None
    error_over_sigma_p99: float | None
    shift_wrong_share: float | None
    zero: BaselineResult
    paper_axis: BaselineResult


@dataclass(frozen=True, slots=True)
class BenchReport:
    """The result of `slipguard bench`."""

    machine: dict[str, Any]
    pipelines: tuple[BenchRow, ...]
    peers: tuple[BenchRow, ...]
    default: str
    thinning: tuple[ThinningResult, ...] = ()
    skips: tuple[SkipResult, ...] = ()
    notes: tuple[str, ...] = ()
    effects: tuple[EffectResult, ...] = ()

    def reference(self, resolution: str) -> BenchRow | None:
        """Return the row of the paper's pipeline that times are compared with; None without a row of this size.

        It uses the first such network of the peers, on its fastest number of threads.
        """
        same_size = [row for row in self.peers if row.estimator == "skeleton" and row.resolution == resolution]
        same_network = [row for row in same_size if row.network == same_size[0].network and row.p50_ms is not None]
        return min(same_network, key=lambda row: row.p50_ms or math.inf, default=None)

    @property
    def thinning_vs_cv2(self) -> float | None:
        """Speed relative to the installed OpenCV, at the size where it is smallest."""
        return min((one.ratios["cv2"] for one in self.thinning), default=None)

    def as_json(self) -> dict[str, Any]:
        """Return the public result, with rounded numbers; unknown values are null."""
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
            "effects": [_plain(asdict(one)) for one in self.effects],
        }


def pareto_front(rows: Iterable[BenchRow]) -> set[str]:
    """Return the names of the rows that no other beats in both mean time over a grasp and mean rotation error."""
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


def machine() -> dict[str, Any]:
    """Return the processor and the versions that the figures were measured with."""
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
    """Return a value for JSON: null for NaN, at most four decimals, lists for tuples."""
    if isinstance(value, float):
        return round(value, 4) if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {key: _plain(one) for key, one in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(one) for one in value]
    return value
