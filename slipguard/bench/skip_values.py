"""The value of each skip: time saved, error added, and delay of the slip detection."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from slipguard.bench.holding import HoldingResult, HoldingScene, measure_holding
from slipguard.bench.pipeline_results import PipelineResults
from slipguard.bench.pipelines import BenchPipeline
from slipguard.bench.results import SkipResult
from slipguard.bench.slip_onset import (
    ROTATION_RATES_DEG_S,
    TRANSLATION_RATES_MM_S,
    SlipOnset,
    SlipWatch,
    detection_delay,
    first_detection,
)
from slipguard.control.finger_fusion import fuse
from slipguard.datasets.rendered_grasps import render_grasp
from slipguard.perception.estimate import Estimate
from slipguard.perception.settings import PerceptionSettings
from slipguard.perception.skipping import ALL_SKIPS, Skips, repeat_estimate, second_finger_can_skip
from slipguard.sim.catalogue import find_object, object_names
from slipguard.tools.parallel import Workers, each

SEED = 7000
QUICK_ONSETS = (
    SlipOnset("key", SEED, 8.0),
    SlipOnset("wrench", SEED + 1, 30.0),
    SlipOnset("ring", SEED + 2, 5.0, translates=True),
)
FULL_SEEDS = 1
TIMED_REPEATS = 2
CLEARER_FINGER, OTHER_FINGER = HoldingScene("wrench", 6000), HoldingScene("wrench", 6005, press=0.25, sign=-1.0)
"""The other finger's contact is faint: often too faint to detect that an image is unchanged."""


def onsets(quick: bool) -> list[SlipOnset]:
    """Return slips after rest, fast and slow, rotations and translations, of every test object."""
    if quick:
        return list(QUICK_ONSETS)
    found = []
    for name in object_names("test"):
        for k in range(FULL_SEEDS):
            if find_object(name).axial:
                found += [SlipOnset(name, SEED + k, rate) for rate in ROTATION_RATES_DEG_S]
            found += [SlipOnset(name, SEED + k, rate, translates=True) for rate in TRANSLATION_RATES_MM_S]
    return found


def measure_skips(
    quick: bool, default: BenchPipeline, held: dict[str, HoldingResult], workers: Workers
) -> tuple[SkipResult, ...]:
    """Return for each skip the time it saves, the error it adds, and how much later slip is detected."""
    found_delays = each(partial(_delays, default), onsets(quick), Workers(jobs=1) if quick else workers)
    empty_delays, unchanged_delays = (list(one) for one in zip(*found_delays, strict=True))
    found = [
        _no_contact(default, 1 if quick else 6, empty_delays),
        _unchanged(quick, default, held, unchanged_delays),
    ]
    return tuple(found if quick else [*found, measure_second_finger(default)])


def _no_contact(default: BenchPipeline, objects: int, delays: list[int | None]) -> SkipResult:
    gated, plain = PipelineResults(), PipelineResults()
    missed = frames = 0
    without_gate = replace(default, skips=Skips(no_contact=False, unchanged=False))
    for name in object_names("test")[:objects]:
        grasp = render_grasp(name, SEED)
        empty = [shot for shot in grasp.shots if not shot.contact]
        for pipeline, results in ((default, gated), (without_gate, plain)):
            for shot in empty * TIMED_REPEATS:
                results.run(pipeline.open(grasp), grasp, [shot])
        with_gate, with_network = default.open(grasp), without_gate.open(grasp)
        for shot in grasp.shots:
            skipped = with_gate.process(shot.frame).skipped == "no contact"
            missed += with_network.process(shot.frame).contact and skipped
            frames += 1
    # Without the gate, a frame without contact takes the time of finding no region.
    saved = float(np.median(plain.busy_ms + plain.empty_ms + plain.other_ms)) - float(np.median(gated.empty_ms))
    how = (
        f"{len(gated.empty_ms)} frames without contact; {missed} of {frames} frames skipped although the network finds "
        f"contact; {_detected(delays)}"
    )
    return SkipResult("no contact: no network", True, saved, None, None, _longest(delays), how)


def _unchanged(
    quick: bool, default: BenchPipeline, held: dict[str, HoldingResult], delays: list[int | None]
) -> SkipResult:
    """Measure a minute of holding with and without the skip."""
    without = replace(default, skips=replace(ALL_SKIPS, unchanged=False))
    step = {without.name: 10} if quick else {without.name: 1}
    other = measure_holding([without], HoldingScene(), step)[without.name]
    own = held[default.name]
    skipped = own.skipped.get("unchanged", 0)
    saved_per_frame = (other.cpu_s_per_minute - own.cpu_s_per_minute) / 3.6
    error = float(np.mean(own.errors_deg) - np.mean(other.errors_deg))
    how = f"{skipped} of {own.frames} frames of a minute of holding; {_detected(delays)}"
    saved = saved_per_frame * own.frames / max(skipped, 1)
    return SkipResult("unchanged: the last estimate", True, saved, saved_per_frame, error, _longest(delays), how)


def _delays(default: BenchPipeline, onset: SlipOnset) -> tuple[int | None, int | None]:
    """Return by how many frames skipping delays the detection: without contact, and unchanged frames.

    None if the slip is not detected without the skip.
    """
    grasp = onset.grasp()
    frames = [shot.frame for shot in grasp.shots]

    def detection(skips: Skips) -> int | None:
        return first_detection(replace(default, skips=skips).open(grasp).process, frames)

    skipping = detection(ALL_SKIPS)
    no_contact, unchanged = (detection(replace(ALL_SKIPS, **{name: False})) for name in ("no_contact", "unchanged"))
    return detection_delay(skipping, no_contact, len(frames)), detection_delay(skipping, unchanged, len(frames))


def _longest(delays: list[int | None]) -> int | None:
    return max((one for one in delays if one is not None), default=None)


def _detected(delays: list[int | None]) -> str:
    missed = delays.count(None)
    return f"{len(delays) - missed} slips after rest detected, {missed} not detected without skipping either"


@dataclass(slots=True)
class _FingerRun:
    """Results with or without the skip. spent_s: for the second finger. slips: frames at which slip was detected."""

    spent_s: list[float] = field(default_factory=list)
    errors_deg: list[float] = field(default_factory=list)
    slips: list[int] = field(default_factory=list)
    skipped: int = 0


def measure_second_finger(default: BenchPipeline) -> SkipResult:
    """Measure a minute of holding with both fingers processed, and with the second one skipped where possible."""
    runs = {True: _FingerRun(), False: _FingerRun()}
    clearer = default.open(CLEARER_FINGER.sensor())
    others = {skip: default.open(OTHER_FINGER.sensor()) for skip in runs}
    watches, slipping = {skip: SlipWatch() for skip in runs}, dict.fromkeys(runs, False)
    last: dict[bool, Estimate | None] = dict.fromkeys(runs)
    refresh_s = PerceptionSettings().refresh_s
    for index, (shot, other_shot) in enumerate(zip(CLEARER_FINGER.shots(), OTHER_FINGER.shots(), strict=True)):
        left = clearer.process(shot.frame)
        for skip, run in runs.items():
            own, frame = last[skip], other_shot.frame
            start_s = time.process_time()
            if skip and own is not None and second_finger_can_skip(own, left, frame.captured_at_s, refresh_s):
                right = repeat_estimate(own, frame.captured_at_s, frame.sequence)
                run.skipped += 1
            else:
                right = others[skip].process(frame)
            run.spent_s.append(time.process_time() - start_s)
            last[skip] = right
            fused = fuse(left, right)
            if fused is None:
                continue
            if shot.compared and fused.rotation_deg is not None:
                run.errors_deg.append(abs(fused.rotation_deg - shot.rotation_deg))
            slips = watches[skip].slips(fused)
            if slips and not slipping[skip]:
                run.slips.append(index)
            slipping[skip] = slips
    with_skip, plain = runs[True], runs[False]
    saved_ms = 1e3 * (float(np.mean(plain.spent_s)) - float(np.mean(with_skip.spent_s)))
    delays = [one - other for one, other in zip(with_skip.slips, plain.slips, strict=False)]
    if len(with_skip.slips) < len(plain.slips):
        delays.append(len(plain.spent_s))
    return SkipResult(
        "second finger adds nothing: its last estimate",
        True,
        saved_ms * len(plain.spent_s) / max(with_skip.skipped, 1),
        saved_ms,
        float(np.mean(with_skip.errors_deg) - np.mean(plain.errors_deg)),
        max(delays, default=None),
        f"{with_skip.skipped} of {len(plain.spent_s)} frames of the less pressed finger; {len(plain.slips)} slips",
    )
