"""Times, errors and mask overlaps of one pipeline over many grasps; picklable."""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.bench.pipelines import BenchPipeline, FrameProcessor
from slipguard.bench.results import BenchRow
from slipguard.datasets.mask_scores import dice, iou
from slipguard.datasets.rendered_grasps import EXTRA_PLAIN, ROUND_PLAIN, ROUND_TEXTURED, GraspFrame, RenderedGrasp
from slipguard.perception.estimate import Estimate
from slipguard.tools.sample_statistics import mean, quantile

CONFIDENT_SIGMAS = 3.0
QUARTERS = 4


@dataclass(slots=True)
class GraspErrors:
    """Errors of one grasp. found: (absolute error, rotation, sigma) where not declined. compared: number of frames."""

    object_name: str
    readable: bool
    difficulty: float
    compared: int = 0
    found: list[tuple[float, float, float | None]] = field(default_factory=list)


@dataclass(slots=True)
class PipelineResults:
    """Times of `process` in ms by kind of frame, overlaps as (Dice, IoU), and errors.

    busy: measured, with contact. other: measured, no contact found. empty: skipped, no contact. unchanged: skipped.
    """

    busy_ms: list[float] = field(default_factory=list)
    empty_ms: list[float] = field(default_factory=list)
    unchanged_ms: list[float] = field(default_factory=list)
    other_ms: list[float] = field(default_factory=list)
    stage_ms: dict[str, list[float]] = field(default_factory=dict)
    overlaps: list[tuple[float, float]] = field(default_factory=list)
    grasps: list[GraspErrors] = field(default_factory=list)

    def begin(self, grasp: RenderedGrasp) -> GraspErrors:
        """Add a grasp; return the record for its errors."""
        errors = GraspErrors(grasp.object_name, grasp.readable, difficulty(grasp))
        self.grasps.append(errors)
        return errors

    def take(self, processor: FrameProcessor, shot: GraspFrame, errors: GraspErrors) -> Estimate:
        """Process the next frame of a grasp. A labeled contact that is skipped as "no contact" has an overlap of 0."""
        start_s = time.perf_counter()
        estimate = processor.process(shot.frame)
        self._add_time(estimate, 1e3 * (time.perf_counter() - start_s))
        if shot.contact and shot.mask is not None:
            label = shot.mask > 0
            if estimate.skipped is None and estimate.segmented:
                found = processor.last_mask > 0
                self.overlaps.append((dice(found, label), iou(found, label)))
            elif estimate.skipped == "no contact" and label.any():
                self.overlaps.append((0.0, 0.0))
        if shot.compared:
            errors.compared += 1
            if estimate.rotation_deg is not None:
                errors.found.append(
                    (abs(estimate.rotation_deg - shot.rotation_deg), estimate.rotation_deg, estimate.sigma_deg)
                )
        return estimate

    def run(self, processor: FrameProcessor, grasp: RenderedGrasp, shots: Iterable[GraspFrame]) -> None:
        """Process these frames of a grasp and add their times and errors."""
        errors = self.begin(grasp)
        for shot in shots:
            self.take(processor, shot, errors)

    def _add_time(self, estimate: Estimate, spent_ms: float) -> None:
        if estimate.skipped == "no contact":
            self.empty_ms.append(spent_ms)
        elif estimate.skipped is not None:
            self.unchanged_ms.append(spent_ms)
        elif estimate.contact:
            self.busy_ms.append(spent_ms)
            for stage, ms in estimate.stage_ms.items():
                self.stage_ms.setdefault(stage, []).append(ms)
        else:
            self.other_ms.append(spent_ms)

    def add(self, other: PipelineResults) -> None:
        """Add the results of other grasps."""
        self.busy_ms += other.busy_ms
        self.empty_ms += other.empty_ms
        self.unchanged_ms += other.unchanged_ms
        self.other_ms += other.other_ms
        for stage, spent in other.stage_ms.items():
            self.stage_ms.setdefault(stage, []).extend(spent)
        self.overlaps += other.overlaps
        self.grasps += other.grasps

    def row(
        self, pipeline: BenchPipeline, times: PipelineResults, grasp_ms: float | None, cpu_s: float | None
    ) -> BenchRow:
        """Return the row. times: the results with the times to use. grasp_ms, cpu_s: of a minute of holding."""
        known = not pipeline.timing_only
        manifest = [one for one in self.grasps if one.object_name not in EXTRA_PLAIN] if known else []
        errors = [error for one in manifest for error, _, _ in one.found]
        per_object: dict[str, list[float]] = {}
        for one in manifest:
            per_object.setdefault(one.object_name, []).extend(error for error, _, _ in one.found)
        readable = [one for one in manifest if one.readable]
        with_sigma = [(error, sigma) for one in manifest for error, _, sigma in one.found if sigma is not None]
        textured = [one for one in manifest if one.object_name in ROUND_TEXTURED]
        plain = [one for one in self.grasps if one.object_name in ROUND_PLAIN] if known else []
        return BenchRow(
            name=pipeline.name,
            network=pipeline.network,
            estimator=pipeline.estimator,
            p50_ms=quantile(times.busy_ms, 0.5),
            p99_ms=quantile(times.busy_ms, 0.99),
            skipped_p50_ms=quantile(times.empty_ms + times.unchanged_ms, 0.5),
            turn_error_mean_deg=mean(errors),
            turn_error_worst_object_deg=max((float(np.mean(e)) for e in per_object.values() if e), default=None),
            declined_share=declined_share(readable),
            dice=mean(d for d, _ in self.overlaps) if known else None,
            iou=mean(i for _, i in self.overlaps) if known else None,
            frames=sum(one.compared for one in self.grasps) if known else len(times.busy_ms),
            sequences=len(self.grasps) if known else None,
            resolution=pipeline.resolution,
            skipping=pipeline.skips.unchanged,
            threads=pipeline.threads,
            turns=len(errors) if known else None,
            turn_sequences=sum(bool(one.found) for one in manifest) if known else None,
            mean_ms_per_frame_grasp=grasp_ms,
            cpu_s_per_minute_grasp=cpu_s,
            no_contact_p50_ms=quantile(times.empty_ms, 0.5),
            unchanged_p50_ms=quantile(times.unchanged_ms, 0.5),
            turn_error_readable_mean_deg=mean(error for one in readable for error, _, _ in one.found),
            turn_error_sd_deg=float(np.std(errors)) if errors else None,
            turn_error_p95_deg=quantile(errors, 0.95),
            turn_error_by_quartile_deg=errors_by_quarter(manifest) if errors else None,
            within_1_sigma=mean(float(error <= sigma) for error, sigma in with_sigma),
            within_2_sigma=mean(float(error <= 2.0 * sigma) for error, sigma in with_sigma),
            within_1_sigma_se=within_sigma_se(manifest, 1.0),
            within_2_sigma_se=within_sigma_se(manifest, 2.0),
            round_textured_error_mean_deg=mean(error for one in textured for error, _, _ in one.found),
            round_textured_declined_share=declined_share(textured),
            round_plain_declined_share=declined_share(plain),
            round_plain_confident_share=confident_share(plain),
            stage_ms={
                stage: (
                    float(np.quantile(spent, 0.5)),
                    float(np.quantile(spent, 0.99)),
                    sum(spent) / len(times.busy_ms),
                )
                for stage, spent in times.stage_ms.items()
            },
        )


def declined_share(grasps: list[GraspErrors]) -> float | None:
    compared = sum(one.compared for one in grasps)
    return 1.0 - sum(len(one.found) for one in grasps) / compared if compared else None


def confident_share(grasps: list[GraspErrors]) -> float | None:
    """Return the share of frames with an estimate above three sigmas; without a sigma every estimate counts."""
    compared = sum(one.compared for one in grasps)
    above = [abs(rotation) > CONFIDENT_SIGMAS * (sigma or 0.0) for one in grasps for _, rotation, sigma in one.found]
    return sum(above) / compared if compared else None


def within_sigma_se(grasps: list[GraspErrors], sigmas: float) -> float | None:
    """Return the standard error of the share of errors within `sigmas`, from its variation between grasps.

    It is that of a ratio of two sums over grasps; None for fewer than two grasps with a sigma.
    """
    inside = [[error <= sigmas * sigma for error, _, sigma in one.found if sigma is not None] for one in grasps]
    counts = np.array([(sum(one), len(one)) for one in inside if one])
    if len(counts) < 2:
        return None
    inside_counts, totals = counts[:, 0], counts[:, 1]
    deviations = inside_counts - totals * inside_counts.sum() / totals.sum()
    return float(np.sqrt(np.square(deviations).sum() * len(counts) / (len(counts) - 1)) / totals.sum())


def errors_by_quarter(grasps: list[GraspErrors]) -> tuple[float | None, ...]:
    """Return the mean error of each quarter of the grasps, the easiest first."""
    ordered = sorted(grasps, key=lambda one: one.difficulty)
    parts = np.array_split(np.arange(len(ordered)), QUARTERS)
    return tuple(mean(error for index in part for error, _, _ in ordered[index].found) for part in parts)


def difficulty(grasp: RenderedGrasp) -> float:
    """Return the difficulty of a grasp by its truth only: 0 easy, about 1 hard.

    A quarter each: roundness, share of the contour cut by the frame, speed, growth of the contact. Without masks only
    the last two count.
    """
    masks = [shot.mask for shot in grasp.shots if shot.compared and shot.mask is not None and shot.mask.any()]
    fast = min(grasp.peak_deg_s / 300.0, 1.0)
    grown = min((grasp.growth - 1.0) / 0.8, 1.0)
    if not masks:
        return 0.5 * (fast + grown)
    shapes = [_aspect_and_cut(mask) for mask in masks]
    roundness = float(np.mean([1.0 / aspect for aspect, _ in shapes]))
    cut = min(float(np.mean([share for _, share in shapes])) / 0.3, 1.0)
    return 0.25 * (roundness + cut + fast + grown)


def _aspect_and_cut(mask: NDArray[np.uint8]) -> tuple[float, float]:
    """Return the aspect ratio by second moments, and the share of the contour on the frame's edge."""
    m = cv2.moments(mask, True)
    xx, yy, xy = (m[key] / m["m00"] for key in ("mu20", "mu02", "mu11"))
    middle, half = (xx + yy) / 2.0, float(np.hypot((xx - yy) / 2.0, xy))
    edge = sum(int(np.count_nonzero(side)) for side in (mask[0], mask[-1], mask[:, 0], mask[:, -1]))
    contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return float(np.sqrt((middle + half) / max(middle - half, 1e-6))), edge / max(sum(map(len, contours)), 1)
