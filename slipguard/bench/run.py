"""The bench: which pipelines process which grasps. Errors may be measured on all cores; times are measured alone."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np

from slipguard.bench.effects import measure_effects
from slipguard.bench.holding import HoldingResult, HoldingScene, measure_holding
from slipguard.bench.pipeline_results import PipelineResults
from slipguard.bench.pipelines import (
    NO_SKIP,
    BenchPipeline,
    network_files,
    with_large_network,
    with_small_network,
    with_timing_network,
    without_network,
)
from slipguard.bench.results import BenchReport, BenchRow, machine, pareto_front
from slipguard.bench.skip_values import measure_skips
from slipguard.bench.thinning_times import compare_thinning
from slipguard.datasets.rendered_grasps import EXTRA_PLAIN, STILL_FRAMES, RenderedGrasp, render_grasp
from slipguard.perception.settings import PerceptionSettings
from slipguard.perception.skipping import ALL_SKIPS
from slipguard.sim.catalogue import object_names
from slipguard.tools.parallel import Workers, each

SEED = 4100
QUICK_GRASPS, FULL_GRASPS = 1, 5
"""Grasps of each object, equal for all pipelines."""
QUICK_MASK_EVERY, FULL_MASK_EVERY = 4, 2
LARGE_FRAMES_QUICK, LARGE_TIMED = 30, 3
"""Sample frames for a large network; objects on which slipguard's estimators are timed with it in a full bench."""
WARM_UP_FRAMES = 40
THREAD_GRASPS = 2
"""Grasps whose sample frames decide on how many threads a large network is fastest."""


@dataclass(frozen=True, slots=True)
class BenchOptions:
    """What to measure. model: replaces the shipped network. models: folder of further networks. workers: for errors."""

    quick: bool = True
    model: Path | None = None
    models: Path | None = None
    workers: Workers = field(default_factory=Workers)


@dataclass(frozen=True, slots=True)
class _GraspItem:
    """One grasp for some pipelines. every: frame step of pipelines without memory. warm: warm up before timing."""

    object_name: str
    seed: int
    pipelines: tuple[BenchPipeline, ...]
    mask_every: int
    every: int = 1
    warm: bool = False


def bench(options: BenchOptions, on_progress: Callable[[str, float], None] = lambda _what, _share: None) -> BenchReport:
    """Render grasps with fixed seeds and measure errors and times; on_progress(what, share done) is called repeatedly.

    Sets OpenCV to one thread for the whole process. onnxruntime uses one thread except for the paper's pipeline.
    """
    cv2.setNumThreads(1)
    contract, frame = network_files(options.models)
    small = with_small_network(options.model, all_without_skipping=not options.quick)
    for path in contract:
        small += with_small_network(path, all_without_skipping=False)
    classical = without_network()
    bigger = [*(with_large_network(path) for path in frame), with_timing_network()]
    with_large = [one for group in bigger for one in group if one.kind == "ours" and not options.quick]
    skipping = [one for one in [*small, *classical] if one.skips == ALL_SKIPS or one in classical]
    on_progress("errors", 0.0)
    accuracy = _errors(options, skipping, bigger, lambda share: on_progress("errors", 0.5 * share))
    on_progress("times", 0.5)
    times = accuracy
    if not options.quick:
        times = _times([*small, *classical], with_large, lambda share: on_progress("times", 0.5 + 0.1 * share))
    on_progress("a minute of holding", 0.6)
    default = _default(small)
    alone = (default.name, replace(default, skips=NO_SKIP).name)
    held = measure_holding([one for one in small if one.name in alone or not options.quick], HoldingScene())
    on_progress("the paper's pipeline", 0.75)
    samples = _samples(options.quick)
    peers = _peer_rows(options, bigger, classical, accuracy, times, samples)
    on_progress("thinning", 0.85)
    masks = [shot.mask for one in samples for shot in one.shots if shot.mask is not None]
    thinned = compare_thinning(masks[:: 4 if options.quick else 2], repeats=2 if options.quick else 3)
    on_progress("value of each skip", 0.9)
    skip_results = measure_skips(options.quick, default, held, options.workers)
    on_progress("effects", 0.93)
    effects = measure_effects(
        options.quick, default, options.workers, lambda share: on_progress("effects", 0.93 + 0.07 * share)
    )
    rows = [_row(one, accuracy, times, held, held[default.name]) for one in [*small, *with_large]]
    front = pareto_front([*rows, *peers])
    rows, peers = ([replace(row, pareto=row.name in front) for row in some] for some in (rows, peers))
    return BenchReport(
        machine(), tuple(rows), tuple(peers), default.name, thinned, skip_results, tuple(_notes(options, held)), effects
    )


def _default(small: list[BenchPipeline]) -> BenchPipeline:
    estimator = PerceptionSettings().estimator
    return next(one for one in small if one.estimator == estimator and one.skips == ALL_SKIPS)


def _errors(
    options: BenchOptions,
    skipping: list[BenchPipeline],
    bigger: list[list[BenchPipeline]],
    on_share: Callable[[float], None],
) -> dict[str, PipelineResults]:
    """Return the errors of all pipelines by name; in a quick bench also their times."""
    objects = [*object_names("test"), *EXTRA_PLAIN]
    grasps = QUICK_GRASPS if options.quick else FULL_GRASPS
    mask_every = QUICK_MASK_EVERY if options.quick else FULL_MASK_EVERY
    plan = [(name, SEED + k) for k in range(grasps) for name in objects]
    others = [] if options.quick else [one for group in bigger for one in group if not one.timing_only]
    items = [
        _GraspItem(name, seed, (*skipping, *others), mask_every, 2 if options.quick else 1, warm=not index)
        for index, (name, seed) in enumerate(plan)
    ]
    workers = Workers(jobs=1) if options.quick else options.workers
    total: dict[str, PipelineResults] = {}

    def progress(done: int) -> None:
        on_share(done / len(items))

    for found in each(_measure, items, workers, named=_describe, progress=progress):
        for name, results in found.items():
            total.setdefault(name, PipelineResults()).add(results)
    return total


def _describe(item: _GraspItem) -> str:
    return f"{item.object_name}, grasp {item.seed}"


def _measure(item: _GraspItem) -> dict[str, PipelineResults]:
    """Process one grasp with all pipelines of an item, one after the other."""
    grasp = render_grasp(item.object_name, item.seed, with_masks=True, mask_every=item.mask_every)
    if item.warm:
        _warm(item.pipelines, grasp)
    # A pipeline without memory starts at the last frame at rest, which is its reference.
    begin = next(index for index, shot in enumerate(grasp.shots) if shot.compared) - 1
    if item.mask_every <= STILL_FRAMES:
        begin -= begin % item.mask_every  # a frame at rest that has a mask
    found = {}
    for pipeline in item.pipelines:
        results = found[pipeline.name] = PipelineResults()
        shots = grasp.shots if pipeline.kind == "ours" else grasp.shots[begin : -1 : item.every]
        results.run(pipeline.open(grasp), grasp, shots)
    return found


def _warm(pipelines: tuple[BenchPipeline, ...], grasp: RenderedGrasp) -> None:
    for pipeline in pipelines:
        processor = pipeline.open(grasp)
        for shot in grasp.shots[: 2 if pipeline.large else WARM_UP_FRAMES]:
            processor.process(shot.frame)


def _times(
    pipelines: list[BenchPipeline], with_large: list[BenchPipeline], on_share: Callable[[float], None]
) -> dict[str, PipelineResults]:
    """Return times, measured serially on a few grasps. with_large: pipelines for the first of them only."""
    total: dict[str, PipelineResults] = {}
    objects = object_names("test")
    for index, name in enumerate(objects):
        timed = (*pipelines, *(with_large if index < LARGE_TIMED else ()))
        item = _GraspItem(name, SEED, timed, 10**6, warm=not index)
        for one, results in _measure(item).items():
            total.setdefault(one, PipelineResults()).add(results)
        on_share((index + 1) / len(objects))
    return total


def _row(
    pipeline: BenchPipeline,
    accuracy: dict[str, PipelineResults],
    times: dict[str, PipelineResults],
    held: dict[str, HoldingResult],
    like: HoldingResult,
) -> BenchRow:
    """Return a pipeline's row. like: results of holding whose share of skipped frames is used if this has none."""
    # These grasps never rest, so that skipping does not change their errors.
    twin = replace(pipeline, skips=ALL_SKIPS).name
    own = accuracy.get(pipeline.name) or accuracy[twin]
    spent = times.get(pipeline.name) or times[twin]
    over = held.get(pipeline.name)
    if over is not None:
        return own.row(pipeline, spent, over.mean_ms, over.cpu_s_per_minute)
    mean_ms = float(np.mean(spent.busy_ms)) if spent.busy_ms else None
    if mean_ms is not None and pipeline.skips.unchanged:
        measured = 1.0 - sum(like.skipped.values()) / like.frames
        mean_ms = like.mean_ms + measured * (mean_ms - like.measured_ms)
    return own.row(pipeline, spent, mean_ms, None if mean_ms is None else 3.6 * mean_ms)


def _peer_rows(
    options: BenchOptions,
    bigger: list[list[BenchPipeline]],
    classical: list[BenchPipeline],
    accuracy: dict[str, PipelineResults],
    times: dict[str, PipelineResults],
    samples: list[RenderedGrasp],
) -> list[BenchRow]:
    """Return the rows of the paper's pipeline, on one thread and on its fastest number, then of the classical ones."""
    rows = []
    for group in bigger:
        pipeline = next(one for one in group if one.kind == "paper")
        if options.quick and "unet" in pipeline.network.lower():
            continue
        found = accuracy.get(pipeline.name, PipelineResults())
        cores = sorted({1, *(count for count in (2, 4, 8) if count <= (os.cpu_count() or 1))})
        tried = {count: _sample_results(replace(pipeline, threads=count), samples[:THREAD_GRASPS]) for count in cores}
        best = min(tried, key=lambda count: float(np.median(tried[count].busy_ms)))
        for count in sorted({1, best}):
            spent = _sample_results(replace(pipeline, threads=count), samples)
            mean_ms = float(np.mean(spent.busy_ms))
            counted = found if found.grasps else spent
            rows.append(counted.row(replace(pipeline, threads=count), spent, mean_ms, 3.6 * mean_ms * count))
    for pipeline in classical:
        spent = times[pipeline.name]
        over_ms = float(np.mean(spent.busy_ms)) if spent.busy_ms else None
        rows.append(accuracy[pipeline.name].row(pipeline, spent, over_ms, None if over_ms is None else 3.6 * over_ms))
    return rows


def _samples(quick: bool) -> list[RenderedGrasp]:
    """Return about thirty frames for large networks: of each test object the last at rest and some rotated ones."""
    objects = object_names("test")
    each_object = -(-LARGE_FRAMES_QUICK // len(objects)) + (0 if quick else 2)
    found = []
    for name in objects:
        grasp = render_grasp(name, SEED, with_masks=True, mask_every=QUICK_MASK_EVERY)
        chosen = [shot for shot in grasp.shots if shot.contact and shot.mask is not None and shot.mask.any()]
        rotated = [shot for shot in chosen if shot.compared]
        picks = np.linspace(0, len(rotated) - 1, each_object).astype(int)
        still = [shot for shot in chosen if not shot.compared][-1:]
        found.append(replace(grasp, shots=(*still, *(rotated[pick] for pick in picks))))
    return found


def _sample_results(pipeline: BenchPipeline, samples: list[RenderedGrasp]) -> PipelineResults:
    results = PipelineResults()
    for index, grasp in enumerate(samples):
        masks = {shot.frame.sequence: shot.mask for shot in grasp.shots if shot.mask is not None}
        if index == 0:
            warm = pipeline.open(grasp, masks)
            for shot in grasp.shots[:3]:
                warm.process(shot.frame)
        results.run(pipeline.open(grasp, masks), grasp, grasp.shots)
    return results


def _notes(options: BenchOptions, held: dict[str, HoldingResult]) -> list[str]:
    """Return notes that explain how the figures were measured."""
    objects = len(object_names("test")) + len(EXTRA_PLAIN)
    grasps = QUICK_GRASPS if options.quick else FULL_GRASPS
    skipped = next(iter(held.values())).skipped
    sample = "about thirty frames for the paper's pipeline" if options.quick else "equal for all pipelines"
    counts = ", ".join(f"{count} ({reason})" for reason, count in sorted(skipped.items()))
    return [
        (
            f"{grasps} × {objects} rendered grasps of objects that are not in the training images, rotations to ±30° "
            f"at 60 fps, with changes of force and shear, {sample}; rendered images differ from real ones: use the "
            "errors to compare pipelines"
        ),
        (
            "estimates: the number of errors; declined frames have none, nor do those of the two plain round objects "
            "that are not in the manifest and show no rotation"
        ),
        f"a minute of holding: 3600 frames of one grasp, of which slipguard skips {counts}",
        "for a large network with slipguard's estimators that minute is computed with the same skipped frames",
        "the paper's pipeline skips no frames",
        (
            "effects: one object and seed per grasp, rotations to ±20°, the default pipeline; zero: always answers 0; "
            "axis: the paper's axis, by thinning slipguard's own masks"
        ),
    ]
