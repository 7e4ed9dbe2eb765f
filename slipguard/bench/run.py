"""The bench: cases for all pipelines. Errors may be measured on all cores; times are measured in this process alone."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from skimage.morphology import skeletonize

from slipguard.bench.pipelines import (
    NO_SKIP,
    BenchPipeline,
    network_files,
    with_large_network,
    with_small_network,
    with_timing_network,
    without_network,
)
from slipguard.bench.results import (
    BenchReport,
    BenchRow,
    EffectResult,
    ThinningResult,
    bench_row,
    effect_result,
    machine,
    mean_ms,
    skip_result,
    times_ms,
)
from slipguard.bench.scenes import Scene, SceneOutcome, measure, single_skips
from slipguard.datasets.effect_scenes import EFFECTS, effect_cases
from slipguard.datasets.rendered_grasps import EXTRA_PLAIN, render_grasp
from slipguard.perception.skeleton import thin
from slipguard.perception.skipping import ALL_SKIPS, UNCHANGED
from slipguard.sim.catalogue import object_names
from slipguard.tools.experiment import Case, run_cases
from slipguard.tools.figures import Figures
from slipguard.tools.parallel import Workers

SEED, EFFECT_SEED, HELD_SEED = 4100, 9100, 6000
"""Estimators were tuned on other seeds and objects."""
QUICK_GRASPS, FULL_GRASPS = 1, 5
"""Grasps of each object, equal for all pipelines."""
QUICK_EFFECT_CASES, FULL_EFFECT_SEEDS = 4, 3
LARGE_EVERY = 32
"""Frame step in which large networks are timed: a multiple of the frames with a label."""
HELD_OBJECT = "wrench"
THINNED_MASKS = 8

Ran = tuple[Case[Scene], dict[str, SceneOutcome]]
Outcomes = dict[str, list[SceneOutcome]]


@dataclass(frozen=True, slots=True)
class BenchOptions:
    """What to measure. model: replaces the shipped network. models: folder of further networks. workers: for errors."""

    quick: bool = True
    model: Path | None = None
    models: Path | None = None
    workers: Workers = field(default_factory=Workers)


def bench(options: BenchOptions, on_progress: Callable[[str, float], None] = lambda what, share: None) -> BenchReport:
    """Render grasps with fixed seeds and measure errors and times; on_progress(what, share done) is called repeatedly.

    Sets OpenCV to one thread for the whole process. onnxruntime uses one thread except for the paper's pipeline.
    """
    cv2.setNumThreads(1)
    quick, workers = options.quick, Workers(jobs=1) if options.quick else options.workers
    contract, frame = network_files(options.models)
    small = with_small_network(options.model, all_without_skipping=not quick)
    default = small[0]
    small += chain.from_iterable(with_small_network(path) for path in contract)
    large = [one for group in (*map(with_large_network, frame), with_timing_network()) for one in group]
    with_large = [one for one in large if one.kind == "ours" and not quick]
    peers = [*(one for one in large if one.kind == "paper"), without_network()]
    skipping = [one for one in small if one.skips == ALL_SKIPS]

    def ran(what: str, cases: Sequence[Case[Scene]], begin: float, end: float, of: Workers) -> list[Ran]:
        return list(
            run_cases(measure, cases, of, progress=lambda done: on_progress(what, begin + (end - begin) * done))
        )

    one_thread = [one for one in peers if one.threads == 1 and not one.timing_only]
    judged = (*skipping, *with_large, *(peers if quick else one_thread))
    found = by_pipeline(ran("errors", grasp_cases(quick, judged, LARGE_EVERY if quick else 1), 0.0, 0.5, workers))
    timed = found
    if not quick:
        cases = grasp_cases(True, (*small, *with_large, *peers), LARGE_EVERY)
        timed = by_pipeline(ran("times", cases, 0.5, 0.65, Workers(jobs=1)))
    skips = single_skips(default)
    held_pipelines = (default, replace(default, skips=NO_SKIP), *skips.values(), *(() if quick else skipping[1:]))
    held_case = Case(HELD_OBJECT, HELD_SEED, Scene("holding", held_pipelines))
    [(_, held)] = ran("holding", [held_case], 0.65, 0.85, Workers(jobs=1))
    effects = effect_results(default, ran("effects", effect_cases_for(quick, default), 0.85, 1.0, workers))
    rows = tuple(_row(one, found, timed, held, default) for one in (*small, *with_large))
    return BenchReport(
        machine(),
        rows,
        tuple(_row(one, found, timed, held, default) for one in peers),
        default.name,
        (compare_thinning(_masks()),),
        tuple(skip_result(name, held[default.name], held[one.name]) for name, one in skips.items()),
        tuple(_notes(quick, held[default.name])),
        effects,
    ).with_front()


def by_pipeline(ran: Sequence[Ran]) -> Outcomes:
    """Return the outcomes of each pipeline by its name, in the order of the cases."""
    total: Outcomes = {}
    for _, outcome in ran:
        for name, one in outcome.items():
            total.setdefault(name, []).append(one)
    return total


def grasp_cases(quick: bool, pipelines: tuple[BenchPipeline, ...], sparse: int) -> list[Case[Scene]]:
    """Return the cases of known rotation: grasps of the test objects and of two plain round ones."""
    plan = [
        (name, SEED + k)
        for k in range(QUICK_GRASPS if quick else FULL_GRASPS)
        for name in (*object_names("test"), *EXTRA_PLAIN)
    ]
    every = 4 if quick or sparse > 1 else 2
    return [
        Case(name, seed, Scene("grasp", pipelines, every, warm=not number, sparse=sparse))
        for number, (name, seed) in enumerate(plan)
    ]


def effect_cases_for(quick: bool, default: BenchPipeline) -> list[Case[Scene]]:
    """Return the cases of every effect, for the default pipeline and two baselines. quick: a few objects, once each."""
    pipelines = (default, BenchPipeline("zero"), replace(default, kind="paper axis", skips=NO_SKIP))
    planned = []
    for effect in EFFECTS:
        names = effect_cases(effect)
        chosen = [names[k] for k in np.linspace(0, len(names) - 1, QUICK_EFFECT_CASES).astype(int)] if quick else names
        seeds = range(EFFECT_SEED, EFFECT_SEED + (1 if quick else FULL_EFFECT_SEEDS))
        planned += [Case(name, seed, Scene(effect, pipelines)) for name in chosen for seed in seeds]
    return planned


def effect_results(default: BenchPipeline, ran: Sequence[Ran]) -> tuple[EffectResult, ...]:
    """Return the figures of each effect."""
    results = []
    for effect in EFFECTS:
        found = by_pipeline([one for one in ran if one[0].parameters.kind == effect])
        results.append(effect_result(effect, found[default.name], found["zero"], found["paper axis"]))
    return tuple(results)


def _row(
    pipeline: BenchPipeline,
    found: Outcomes,
    timed: Outcomes,
    held: Mapping[str, SceneOutcome],
    default: BenchPipeline,
) -> BenchRow:
    """Return a pipeline's row. Skips and threads do not change the errors, for these grasps never rest."""
    alike = pipeline.name
    if alike not in found:
        alike = replace(pipeline, skips=ALL_SKIPS if pipeline.kind == "ours" else NO_SKIP, threads=1).name
    errors, times = found.get(alike, []), timed.get(pipeline.name) or timed[alike]
    if pipeline.name in held:
        return bench_row(pipeline, errors, times, mean_ms(held[pipeline.name]))
    busy_ms, like = Figures.of(times_ms(times, "contact")).mean, held[default.name]
    if busy_ms is not None and pipeline.skips.unchanged:
        contact_ms = like.times_ms["contact"]
        frames = sum(map(len, like.times_ms.values()))
        busy_ms = (mean_ms(like) or 0.0) + len(contact_ms) / frames * (busy_ms - float(np.mean(contact_ms)))
    return bench_row(pipeline, errors, times, busy_ms)


def _masks() -> list[NDArray[np.uint8]]:
    """Return some labels of test objects, (320, 240) uint8, 0 or 1."""
    names = object_names("test")[:THINNED_MASKS]
    grasps = [render_grasp(name, SEED, with_masks=True, mask_every=12) for name in names]
    return [next(shot.mask for shot in one.shots if shot.mask is not None and shot.mask.any()) for one in grasps]


def compare_thinning(masks: list[NDArray[np.uint8]], repeats: int = 3) -> ThinningResult:
    """Measure slipguard's thinning, OpenCV's and scikit-image's: the minimum of some repeats, the median over masks."""

    def opencv(mask: NDArray[np.uint8]) -> NDArray[np.uint8]:
        lines = cv2.ximgproc.thinning(mask * np.uint8(255), thinningType=cv2.ximgproc.THINNING_GUOHALL)
        return np.asarray(lines > 0, np.uint8)

    def median_ms(implementation: Callable[[NDArray[np.uint8]], object]) -> float:
        def spent_ms(mask: NDArray[np.uint8]) -> float:
            began_s = time.perf_counter()
            implementation(mask)
            return 1e3 * (time.perf_counter() - began_s)

        return float(np.median([min(spent_ms(mask) for _ in range(repeats)) for mask in masks]))

    own_ms = median_ms(thin)
    others_ms = {"cv2": median_ms(opencv), "scikit-image": median_ms(skeletonize)}
    different = sum(int(np.count_nonzero(opencv(mask) != (thin(mask) > 0))) for mask in masks)
    ratios = {name: ms / own_ms for name, ms in others_ms.items()}
    return ThinningResult("240×320", len(masks), own_ms, others_ms, ratios, different)


def _notes(quick: bool, held: SceneOutcome) -> list[str]:
    """Return notes that explain how the figures were measured."""
    objects = len(object_names("test")) + len(EXTRA_PLAIN)
    grasps = QUICK_GRASPS if quick else FULL_GRASPS
    sample = f"every {LARGE_EVERY}nd frame for the paper's pipeline" if quick else "equal for all pipelines"
    frames = sum(map(len, held.times_ms.values()))
    counts = ", ".join(f"{len(held.times_ms.get(reason, ()))} ({reason})" for reason in ("no contact", UNCHANGED))
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
        f"mean over a grasp: {frames} frames of one object that is held, of which slipguard skips {counts}",
        "where that is not measured, it is computed with the same skipped frames",
        "the paper's pipeline skips no frames",
        (
            "effects: one object and seed per grasp, rotations to ±20°, the default pipeline; zero: always answers 0; "
            "axis: the paper's axis, by thinning slipguard's own masks"
        ),
    ]
