"""Results of a bench: one row per pipeline, the value of each skip, the effects, and the whole as a JSON object."""

from __future__ import annotations

import math
import platform
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import onnxruntime as ort

from slipguard.bench.pipelines import BenchPipeline
from slipguard.bench.scenes import SceneOutcome
from slipguard.datasets.rendered_grasps import EXTRA_PLAIN, ROUND_PLAIN, ROUND_TEXTURED
from slipguard.tools.figures import Figures, plain, share

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
        mean_ms_per_frame_grasp: While an object is held, as is cpu_s_per_minute_grasp. Where that is not measured, it
            is computed from the pipeline's own times and the default's share of skipped frames.
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
    """The value of one skip, while an object is held.

    Attributes:
        kept: Whether slipguard uses the skip.
        skipped: Number of skipped frames of `frames`; None for a skip that leaves the texture to be measured.
        saved_ms: Time saved per skipped frame.
        saved_ms_per_frame_grasp: Time saved per frame.
        error_added_deg: Mean rotation error with the skip minus without.
    """

    name: str
    kept: bool
    skipped: int | None
    frames: int
    saved_ms: float | None
    saved_ms_per_frame_grasp: float | None
    error_added_deg: float | None


@dataclass(frozen=True, slots=True)
class ThinningResult:
    """Thinning times of masks of one size. ratios: times of other implementations relative to slipguard's."""

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

        It uses the first such network of the peers, on the faster number of threads.
        """
        same_size = [row for row in self.peers if row.estimator == "skeleton" and row.resolution == resolution]
        same_network = [row for row in same_size if row.network == same_size[0].network and row.p50_ms is not None]
        return min(same_network, key=lambda row: row.p50_ms or math.inf, default=None)

    @property
    def thinning_vs_cv2(self) -> float | None:
        """Speed relative to the installed OpenCV."""
        return min((one.ratios["cv2"] for one in self.thinning), default=None)

    def with_front(self) -> BenchReport:
        """Return the report with the rows of the Pareto front marked."""
        front = pareto_front([*self.pipelines, *self.peers])
        marked = [
            tuple(replace(row, pareto=row.name in front) for row in rows) for rows in (self.pipelines, self.peers)
        ]
        return replace(self, pipelines=marked[0], peers=marked[1])

    def as_json(self) -> dict[str, Any]:
        """Return the public result, with rounded numbers; unknown values are null."""
        return {
            "machine": self.machine,
            "pipelines": plain(self.pipelines),
            "peers": plain(self.peers),
            "default": self.default,
            "thinning_vs_cv2": plain(self.thinning_vs_cv2),
            "thinning": plain(self.thinning),
            "skips": plain(self.skips),
            "published": PUBLISHED,
            "notes": list(self.notes),
            "effects": plain(self.effects),
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


CONFIDENT_SIGMAS = 3.0
QUARTERS = 4
WRONG_SHIFT_MM = 0.4
"""Half of the finest pitch of the shafts: a shift that is off by more may have been taken for another period's."""


def bench_row(
    pipeline: BenchPipeline, found: Sequence[SceneOutcome], timed: Sequence[SceneOutcome], held_ms: float | None
) -> BenchRow:
    """Return the figures of one pipeline.

    Args:
        found: Its outcomes in the grasps that errors are measured in; those of one that is for timing only have none.
        timed: Its outcomes in the grasps that times are measured in.
        held_ms: Its mean time of a frame while an object is held.
    """
    if pipeline.timing_only:
        found = ()
    manifest = [one for one in found if one.object_name not in EXTRA_PLAIN]
    readable = [one for one in manifest if one.readable]
    textured = [one for one in manifest if one.object_name in ROUND_TEXTURED]
    plain_ones = [one for one in found if one.object_name in ROUND_PLAIN]
    errors = Figures.of(errors_of(manifest))
    times = {kind: Figures.of(times_ms(timed, kind)) for kind in ("contact", "no contact", "unchanged")}
    overlaps = [overlap for one in found for overlap in one.overlaps]
    per_object = [
        Figures.of(errors_of(one for one in manifest if one.object_name == name)).mean
        for name in {one.object_name for one in manifest}
    ]
    return BenchRow(
        name=pipeline.name,
        network=pipeline.network,
        estimator=pipeline.estimator,
        p50_ms=times["contact"].p50,
        p99_ms=times["contact"].p99,
        skipped_p50_ms=Figures.of(times_ms(timed, "no contact") + times_ms(timed, "unchanged")).p50,
        turn_error_mean_deg=errors.mean,
        turn_error_worst_object_deg=max((mean for mean in per_object if mean is not None), default=None),
        declined_share=declined_share(readable),
        dice=Figures.of(dice for dice, _ in overlaps).mean,
        iou=Figures.of(iou for _, iou in overlaps).mean,
        frames=sum(one.compared for one in found) if found else times["contact"].count,
        sequences=len(found) if found else None,
        resolution=pipeline.resolution,
        skipping=pipeline.skips.unchanged,
        threads=pipeline.threads,
        turns=errors.count if found else None,
        turn_sequences=sum(bool(one.errors) for one in manifest) if found else None,
        mean_ms_per_frame_grasp=held_ms,
        cpu_s_per_minute_grasp=None if held_ms is None else 3.6 * held_ms * pipeline.threads,
        no_contact_p50_ms=times["no contact"].p50,
        unchanged_p50_ms=times["unchanged"].p50,
        turn_error_readable_mean_deg=Figures.of(errors_of(readable)).mean,
        turn_error_sd_deg=errors.sd,
        turn_error_p95_deg=errors.p95,
        turn_error_by_quartile_deg=errors_by_quarter(manifest) if errors.count else None,
        within_1_sigma=within_sigmas(manifest, 1.0),
        within_2_sigma=within_sigmas(manifest, 2.0),
        within_1_sigma_se=within_sigma_se(manifest, 1.0),
        within_2_sigma_se=within_sigma_se(manifest, 2.0),
        round_textured_error_mean_deg=Figures.of(errors_of(textured)).mean,
        round_textured_declined_share=declined_share(textured),
        round_plain_declined_share=declined_share(plain_ones),
        round_plain_confident_share=confident_share(plain_ones),
        stage_ms=_stages(timed, times["contact"].count),
    )


def _stages(timed: Sequence[SceneOutcome], frames: int) -> dict[str, tuple[float, float, float]]:
    names = dict.fromkeys(stage for one in timed for stage in one.stage_ms)
    spent = {stage: [ms for one in timed for ms in one.stage_ms.get(stage, ())] for stage in names}
    return {
        stage: (float(np.quantile(ms, 0.5)), float(np.quantile(ms, 0.99)), sum(ms) / frames)
        for stage, ms in spent.items()
    }


def times_ms(outcomes: Iterable[SceneOutcome], kind: str) -> list[float]:
    return [ms for one in outcomes for ms in one.times_ms.get(kind, ())]


def mean_ms(outcome: SceneOutcome) -> float | None:
    """Return the mean time of a frame of any kind."""
    return Figures.of(ms for spent in outcome.times_ms.values() for ms in spent).mean


def errors_of(outcomes: Iterable[SceneOutcome]) -> list[float]:
    return [error for one in outcomes for error, _, _ in one.errors]


def declined_share(outcomes: Sequence[SceneOutcome]) -> float | None:
    compared = sum(one.compared for one in outcomes)
    return 1.0 - sum(len(one.errors) for one in outcomes) / compared if compared else None


def confident_share(outcomes: Sequence[SceneOutcome]) -> float | None:
    """Return the share of frames with an estimate above three sigmas; without a sigma every estimate counts."""
    compared = sum(one.compared for one in outcomes)
    above = [abs(deg) > CONFIDENT_SIGMAS * (sigma or 0.0) for one in outcomes for _, deg, sigma in one.errors]
    return sum(above) / compared if compared else None


def within_sigmas(outcomes: Iterable[SceneOutcome], sigmas: float) -> float | None:
    return share(error <= sigmas * sigma for one in outcomes for error, _, sigma in one.errors if sigma is not None)


def within_sigma_se(outcomes: Sequence[SceneOutcome], sigmas: float) -> float | None:
    """Return the standard error of the share of errors within `sigmas`, from its variation between grasps.

    It is that of a ratio of two sums over grasps; None for fewer than two grasps with a sigma.
    """
    inside = [[error <= sigmas * sigma for error, _, sigma in one.errors if sigma is not None] for one in outcomes]
    counts = np.array([(sum(one), len(one)) for one in inside if one])
    if len(counts) < 2:
        return None
    inside_counts, totals = counts[:, 0], counts[:, 1]
    deviations = inside_counts - totals * inside_counts.sum() / totals.sum()
    return float(np.sqrt(np.square(deviations).sum() * len(counts) / (len(counts) - 1)) / totals.sum())


def errors_by_quarter(outcomes: Sequence[SceneOutcome]) -> tuple[float | None, ...]:
    """Return the mean error of each quarter of the grasps, the easiest first."""
    ordered = sorted(outcomes, key=lambda one: one.difficulty)
    parts = np.array_split(np.arange(len(ordered)), QUARTERS)
    return tuple(Figures.of(errors_of(ordered[index] for index in part)).mean for part in parts)


def skip_result(name: str, used: SceneOutcome, without: SceneOutcome) -> SkipResult:
    """Return the value of one skip from the same frames with and without it."""
    reason = name.split(":")[0]
    skipped = len(used.times_ms[reason]) if reason in used.times_ms else None
    frames = sum(map(len, used.times_ms.values()))
    saved = (mean_ms(without) or 0.0) - (mean_ms(used) or 0.0)
    added = [Figures.of(errors_of([one])).mean for one in (used, without)]
    return SkipResult(
        name, True, skipped, frames, saved * frames / skipped if skipped else None, saved,
        None if added[0] is None or added[1] is None else added[0] - added[1],
    )  # fmt: skip


def effect_result(
    effect: str, found: Sequence[SceneOutcome], zero: Sequence[SceneOutcome], axis: Sequence[SceneOutcome]
) -> EffectResult:
    """Return the figures of one effect, and those of the two baselines."""
    errors = Figures.of(errors_of(found))
    sigmas = [error / sigma for one in found for error, _, sigma in one.errors if sigma is not None]
    return EffectResult(
        effect=effect,
        n=sum(one.compared for one in found),
        grasps=len(found),
        mean_deg=errors.mean,
        worst_deg=errors.worst,
        declined_share=declined_share(found) or 0.0,
        within_1_sigma=within_sigmas(found, 1.0),
        within_2_sigma=within_sigmas(found, 2.0),
        beyond_3_sigma=share(one > 3.0 for one in sigmas),
        beyond_4_sigma=share(one > 4.0 for one in sigmas),
        error_over_sigma_p99=Figures.of(sigmas).p99,
        shift_wrong_share=share(mm > WRONG_SHIFT_MM for one in found for mm in one.shifts_mm),
        zero=_baseline(zero),
        paper_axis=_baseline(axis),
    )


def _baseline(outcomes: Sequence[SceneOutcome]) -> BaselineResult:
    errors = Figures.of(errors_of(outcomes))
    return BaselineResult(errors.mean, errors.worst, declined_share(outcomes) or 0.0)
