"""The bench: what is run over what, and in which order. Accuracy may use all cores; whatever is timed runs alone."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np

from slipguard.bench.holding import HoldingResult, HoldingScene, hold
from slipguard.bench.pipeline_results import PipelineResults
from slipguard.bench.pipelines import NO_SKIP, BenchPipeline, large, network_files, ours, without_network
from slipguard.bench.results import BenchReport, BenchRow, machine, on_the_front
from slipguard.bench.skip_values import skips
from slipguard.bench.thinning_times import thinning
from slipguard.datasets.rendered_grasps import EXTRA_PLAIN, STILL_FRAMES, RenderedGrasp, render_grasp
from slipguard.perception.settings import PerceptionSettings
from slipguard.perception.skipping import ALL_SKIPS
from slipguard.sim.catalogue import object_names
from slipguard.tools.parallel import Workers, each

SEED = 4100
QUICK_GRASPS, FULL_GRASPS = 1, 5
"""Grasps of each object, the same for every pipeline."""
QUICK_MASK_EVERY, FULL_MASK_EVERY = 4, 2
LARGE_FRAMES_QUICK, LARGE_TIMED = 30, 3
"""Frames of a large network in a quick bench; in a full one the objects that slipguard's estimators are timed on."""
WARM_UP_FRAMES = 40
TRIED_GRASPS = 2
"""So many grasps' sample frames tell on how many threads a large network runs best."""


@dataclass(frozen=True, slots=True)
class BenchOptions:
    """What to bench. model: in place of the shipped network. models: folder of further ones. workers: for accuracy."""

    quick: bool = True
    model: Path | None = None
    models: Path | None = None
    workers: Workers = field(default_factory=Workers)


@dataclass(frozen=True, slots=True)
class _GraspItem:
    """One grasp for some pipelines. every: only so many-th frames go to those that remember nothing.

    warm: run each over some frames before any is timed.
    """

    object_name: str
    seed: int
    subjects: tuple[BenchPipeline, ...]
    mask_every: int
    every: int = 1
    warm: bool = False


def bench(options: BenchOptions, on_progress: Callable[[str, float], None] = lambda _what, _share: None) -> BenchReport:
    """Render, measure, time. on_progress(what, share done) is called now and then. Seeds are fixed.

    Sets OpenCV to one thread for the whole process; onnxruntime runs on one but for the paper's pipeline.
    """
    cv2.setNumThreads(1)
    contract, frame = network_files(options.models)
    small = ours(options.model, every=not options.quick)
    for path in contract:
        small += ours(path, every=False)
    classical = without_network()
    bigger = [*(large(path) for path in frame), large_stand_in()]
    with_large = [one for group in bigger for one in group if one.kind == "ours" and not options.quick]
    thrifty = [one for one in [*small, *classical] if one.skips == ALL_SKIPS or one in classical]
    on_progress("errors", 0.0)
    accuracy = _errors(options, thrifty, bigger, lambda share: on_progress("errors", 0.5 * share))
    on_progress("times", 0.5)
    times = accuracy
    if not options.quick:
        times = _times([*small, *classical], with_large, lambda share: on_progress("times", 0.5 + 0.1 * share))
    on_progress("a minute of holding", 0.6)
    default = _default(small)
    alone = (default.name, replace(default, skips=NO_SKIP).name)
    held = hold([one for one in small if one.name in alone or not options.quick], HoldingScene())
    on_progress("the paper's pipeline", 0.75)
    samples = _samples(options.quick)
    peers = _peer_rows(options, bigger, classical, accuracy, times, samples)
    on_progress("thinning", 0.85)
    masks = [shot.mask for one in samples for shot in one.shots if shot.mask is not None]
    thinned = thinning(masks[:: 4 if options.quick else 2], repeats=2 if options.quick else 3)
    on_progress("what each skip is worth", 0.9)
    worth = skips(options.quick, default, held, options.workers)
    rows = [_row(one, accuracy, times, held, held[default.name]) for one in [*small, *with_large]]
    front = on_the_front([*rows, *peers])
    rows, peers = ([replace(row, pareto=row.name in front) for row in some] for some in (rows, peers))
    return BenchReport(machine(), tuple(rows), tuple(peers), default.name, thinned, worth, tuple(_notes(options, held)))


def large_stand_in() -> list[BenchPipeline]:
    """The paper's network in shape, for times alone."""
    from slipguard.bench.pipelines import PEER_MODEL
    from slipguard.perception.contact.segmenter import default_model_path

    return large(default_model_path().with_name(PEER_MODEL))


def _default(small: list[BenchPipeline]) -> BenchPipeline:
    estimator = PerceptionSettings().estimator
    return next(one for one in small if one.estimator == estimator and one.skips == ALL_SKIPS)


def _errors(
    options: BenchOptions,
    thrifty: list[BenchPipeline],
    bigger: list[list[BenchPipeline]],
    on_share: Callable[[float], None],
) -> dict[str, PipelineResults]:
    """Every pipeline's errors by name; of a quick bench its times, too."""
    objects = [*object_names("test"), *EXTRA_PLAIN]
    grasps = QUICK_GRASPS if options.quick else FULL_GRASPS
    mask_every = QUICK_MASK_EVERY if options.quick else FULL_MASK_EVERY
    plan = [(name, SEED + k) for k in range(grasps) for name in objects]
    others = [] if options.quick else [one for group in bigger for one in group if not one.made_up]
    items = [
        _GraspItem(name, seed, (*thrifty, *others), mask_every, 2 if options.quick else 1, warm=not index)
        for index, (name, seed) in enumerate(plan)
    ]
    workers = Workers(jobs=1) if options.quick else options.workers
    total: dict[str, PipelineResults] = {}

    def progress(done: int) -> None:
        on_share(done / len(items))

    for found in each(_measure, items, workers, named=_named, progress=progress):
        for name, results in found.items():
            total.setdefault(name, PipelineResults()).add(results)
    return total


def _named(item: _GraspItem) -> str:
    return f"{item.object_name}, grasp {item.seed}"


def _measure(item: _GraspItem) -> dict[str, PipelineResults]:
    """One grasp through all pipelines of an item, one after the other."""
    grasp = render_grasp(item.object_name, item.seed, with_masks=True, mask_every=item.mask_every)
    if item.warm:
        _warm(item.subjects, grasp)
    # Without skipping or a reference of its own, a plain pipeline begins at the last still frame.
    begin = next(index for index, shot in enumerate(grasp.shots) if shot.compared) - 1
    if item.mask_every <= STILL_FRAMES:
        begin -= begin % item.mask_every  # a still frame that has its mask
    for subject in item.subjects:
        subject.forget(share=True)
    found = {}
    for subject in item.subjects:
        results = found[subject.name] = PipelineResults()
        shots = grasp.shots if subject.kind == "ours" else grasp.shots[begin : -1 : item.every]
        results.run(subject.open(grasp), grasp, shots)
    for subject in item.subjects:
        subject.forget()
    return found


def _warm(subjects: tuple[BenchPipeline, ...], grasp: RenderedGrasp) -> None:
    for subject in subjects:
        processor = subject.open(grasp)
        for shot in grasp.shots[: 2 if subject.large else WARM_UP_FRAMES]:
            processor.process(shot.frame)


def _times(
    subjects: list[BenchPipeline], with_large: list[BenchPipeline], on_share: Callable[[float], None]
) -> dict[str, PipelineResults]:
    """Times alone, serially, on a few grasps. with_large: on the first few of them."""
    total: dict[str, PipelineResults] = {}
    objects = object_names("test")
    for index, name in enumerate(objects):
        timed = (*subjects, *(with_large if index < LARGE_TIMED else ()))
        item = _GraspItem(name, SEED, timed, 10**6, warm=not index)
        for one, results in _measure(item).items():
            total.setdefault(one, PipelineResults()).add(results)
        on_share((index + 1) / len(objects))
    return total


def _row(
    subject: BenchPipeline,
    accuracy: dict[str, PipelineResults],
    times: dict[str, PipelineResults],
    held: dict[str, HoldingResult],
    like: HoldingResult,
) -> BenchRow:
    """like: a pipeline whose shares of skipped frames count where this one was not run over the minute itself."""
    # Skipping changes no turn of these grasps: they never rest.
    twin = replace(subject, skips=ALL_SKIPS).name
    own = accuracy.get(subject.name) or accuracy[twin]
    spent = times.get(subject.name) or times[twin]
    over = held.get(subject.name)
    if over is not None:
        return own.row(subject, spent, over.mean_ms, over.cpu_s_per_minute)
    mean_ms = float(np.mean(spent.busy_ms)) if spent.busy_ms else None
    if mean_ms is not None and subject.skips.unchanged:
        measured = 1.0 - sum(like.skipped.values()) / like.frames
        mean_ms = like.mean_ms + measured * (mean_ms - like.measured_ms)
    return own.row(subject, spent, mean_ms, None if mean_ms is None else 3.6 * mean_ms)


def _peer_rows(
    options: BenchOptions,
    bigger: list[list[BenchPipeline]],
    classical: list[BenchPipeline],
    accuracy: dict[str, PipelineResults],
    times: dict[str, PipelineResults],
    samples: list[RenderedGrasp],
) -> list[BenchRow]:
    """The paper's pipeline with each network, on one core and on its best number of threads; then the plain ones."""
    rows = []
    for group in bigger:
        subject = next(one for one in group if one.kind == "paper")
        if options.quick and "unet" in subject.network.lower():
            continue
        found = accuracy.get(subject.name, PipelineResults())
        cores = sorted({1, *(count for count in (2, 4, 8) if count <= (os.cpu_count() or 1))})
        tried = {count: _few(replace(subject, threads=count), samples[:TRIED_GRASPS]) for count in cores}
        best = min(tried, key=lambda count: float(np.median(tried[count].busy_ms)))
        for count in sorted({1, best}):
            spent = _few(replace(subject, threads=count), samples)
            mean_ms = float(np.mean(spent.busy_ms))
            counted = found if found.grasps else spent
            rows.append(counted.row(replace(subject, threads=count), spent, mean_ms, 3.6 * mean_ms * count))
    for subject in classical:
        spent = times[subject.name]
        over_ms = float(np.mean(spent.busy_ms)) if spent.busy_ms else None
        rows.append(accuracy[subject.name].row(subject, spent, over_ms, None if over_ms is None else 3.6 * over_ms))
    return rows


def _samples(quick: bool) -> list[RenderedGrasp]:
    """Some thirty frames for large networks: of each test object the last still frame and some turned ones."""
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


def _few(subject: BenchPipeline, samples: list[RenderedGrasp]) -> PipelineResults:
    """The paper's pipeline over the sample frames."""
    results = PipelineResults()
    for index, grasp in enumerate(samples):
        masks = {shot.frame.sequence: shot.mask for shot in grasp.shots if shot.mask is not None}
        if index == 0:
            warm = subject.open(grasp, masks)
            for shot in grasp.shots[:3]:
                warm.process(shot.frame)
        results.run(subject.open(grasp, masks), grasp, grasp.shots)
    return results


def _notes(options: BenchOptions, held: dict[str, HoldingResult]) -> list[str]:
    """What a reader must know to read the figures."""
    objects = len(object_names("test")) + len(EXTRA_PLAIN)
    grasps = QUICK_GRASPS if options.quick else FULL_GRASPS
    skipped = next(iter(held.values())).skipped
    whose = "of which the paper's pipeline sees some thirty frames" if options.quick else "the same for every pipeline"
    out = ", ".join(f"{count} {why}" for why, count in sorted(skipped.items()))
    return [
        (
            f"{grasps} × {objects} rendered grasps of objects that no training image shows, turns to ±30° at 60 fps, "
            f"with force changes and shear, {whose}; rendered is not real: the errors compare pipelines"
        ),
        (
            "turns: what the errors are taken over; declined frames are none, nor are those of the two plain round "
            "objects that are in no manifest, of which nobody can tell a turn"
        ),
        f"a minute of holding: 3600 frames of one grasp, of which slipguard leaves out {out}",
        "of a large network with slipguard's estimators that minute is reckoned, with the same frames left out",
        "the paper's pipeline skips nothing: every frame costs the same",
    ]
