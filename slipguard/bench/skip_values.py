"""The value of each skip: time saved, error added, and delay of the slip detection."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace

import numpy as np

from slipguard.bench.holding import HoldingResult, HoldingScene, hold
from slipguard.bench.pipeline_results import PipelineResults
from slipguard.bench.pipelines import BenchPipeline
from slipguard.bench.results import SkipResult
from slipguard.bench.slip_onset import PARAMS, ROTATION_RATES_DEG_S, SLIDE_RATES_MM_S, SlipOnset, first_seen, later_by
from slipguard.control.finger_fusion import fuse
from slipguard.control.slip_baselines import SlipMemory
from slipguard.control.slip_detector import look
from slipguard.datasets.rendered_grasps import ROUND_PLAIN, render_grasp
from slipguard.perception.estimate import Estimate
from slipguard.perception.settings import PerceptionSettings
from slipguard.perception.skipping import ALL_SKIPS, Skips, repeat_estimate, second_finger_can_skip
from slipguard.sim.catalogue import find_object, object_names
from slipguard.tools.parallel import Workers, each

SEED = 7000
QUICK_ONSETS = (
    SlipOnset("key", SEED, 8.0),
    SlipOnset("wrench", SEED + 1, 30.0),
    SlipOnset("ring", SEED + 2, 5.0, slides=True),
)
FULL_SEEDS = 1
TIMED_REPEATS = 2


@dataclass(frozen=True, slots=True)
class _OnsetTrial:
    onset: SlipOnset
    subject: BenchPipeline


@dataclass(frozen=True, slots=True)
class _OnsetDelay:
    """How many frames later one slip is seen because of each skip; None where it is not seen without the skip."""

    no_contact: int | None
    unchanged: int | None


def onsets(quick: bool) -> list[SlipOnset]:
    """Slips after rest: quick ones and slow, turning and sliding, of every test object."""
    if quick:
        return list(QUICK_ONSETS)
    found = []
    for name in object_names("test"):
        for k in range(FULL_SEEDS):
            if find_object(name).axial:
                found += [SlipOnset(name, SEED + k, rate) for rate in ROTATION_RATES_DEG_S]
            found += [SlipOnset(name, SEED + k, rate, slides=True) for rate in SLIDE_RATES_MM_S]
    return found


def skips(
    quick: bool, default: BenchPipeline, held: dict[str, HoldingResult], workers: Workers
) -> tuple[SkipResult, ...]:
    """Every skip of the default pipeline, measured."""
    tried = [_OnsetTrial(onset, default) for onset in onsets(quick)]
    later = list(each(_later, tried, Workers(jobs=1) if quick else workers))
    found = [
        _no_contact(default, 1 if quick else 6, [one.no_contact for one in later]),
        _unchanged(quick, default, held, [one.unchanged for one in later]),
        _round(default, ROUND_PLAIN[:1] if quick else ROUND_PLAIN),
    ]
    if not quick:
        found.append(second_finger(default))
    return tuple(found)


def _no_contact(default: BenchPipeline, objects: int, later: list[int | None]) -> SkipResult:
    """Frames without contact, with the gate's answer and with the network's."""
    gated, plain = PipelineResults(), PipelineResults()
    missed = frames = 0
    for name in object_names("test")[:objects]:
        grasp = render_grasp(name, SEED)
        empty = [shot for shot in grasp.shots if not shot.contact]
        asked = replace(default, skips=Skips(no_contact=False, unchanged=False))
        for subject, results in ((default, gated), (asked, plain)):
            for shot in empty * TIMED_REPEATS:
                results.run(subject.open(grasp), grasp, [shot])
        quick, slow = default.open(grasp), asked.open(grasp)
        for shot in grasp.shots:
            skipped, contact = quick.process(shot.frame).skipped == "no contact", slow.process(shot.frame).contact
            missed += skipped and contact
            frames += 1
    # Without the gate a frame without contact costs what it takes to find nothing.
    saved = float(np.median(plain.busy_ms + plain.empty_ms + plain.other_ms)) - float(np.median(gated.empty_ms))
    how = (
        f"{len(gated.empty_ms)} frames without contact; {missed} of {frames} frames that the network finds contact in; "
        f"{_seen(later)}"
    )
    return SkipResult("no contact: no network", True, saved, None, None, _most(later), how)


def _unchanged(
    quick: bool, default: BenchPipeline, held: dict[str, HoldingResult], later: list[int | None]
) -> SkipResult:
    """A minute of holding with and without, and slips after rest."""
    without = replace(default, skips=replace(ALL_SKIPS, unchanged=False))
    other = hold([without], HoldingScene(), {without.name: 10} if quick else {without.name: 1})[without.name]
    own = held[default.name]
    left_out = own.skipped.get("unchanged", 0)
    saved_a_frame = (other.cpu_s_per_minute - own.cpu_s_per_minute) / 3.6
    error = float(np.mean(own.errors_deg) - np.mean(other.errors_deg))
    how = f"{left_out} of {own.frames} frames of a minute of holding; {_seen(later)}"
    saved = saved_a_frame * own.frames / max(left_out, 1)
    return SkipResult("unchanged: the last answer", True, saved, saved_a_frame, error, _most(later), how)


def _later(tried: _OnsetTrial) -> _OnsetDelay:
    grasp = tried.onset.grasp()
    frames = [shot.frame for shot in grasp.shots]

    def seen(skips: Skips) -> int | None:
        return first_seen(replace(tried.subject, skips=skips).open(grasp).process, frames)

    skipping = seen(ALL_SKIPS)
    without = [seen(replace(ALL_SKIPS, no_contact=False)), seen(replace(ALL_SKIPS, unchanged=False))]
    return _OnsetDelay(*(later_by(skipping, one, len(frames)) for one in without))


def _most(later: list[int | None]) -> int | None:
    return max((one for one in later if one is not None), default=None)


def _seen(later: list[int | None]) -> str:
    unseen = later.count(None)
    return f"{len(later) - unseen} slips after rest ({unseen} that nobody sees aside)"


def _round(default: BenchPipeline, objects: tuple[str, ...]) -> SkipResult:
    """Plain round contacts with and without thinning."""
    spent: dict[bool, PipelineResults] = {True: PipelineResults(), False: PipelineResults()}
    differ = 0
    for name in objects:
        grasp = render_grasp(name, SEED)
        answers: dict[bool, list[float | None]] = {}
        for kept in (True, False):
            subject = replace(default, skips=replace(ALL_SKIPS, round=kept))
            spent[kept].run(subject.open(grasp), grasp, grasp.shots)
            processor = subject.open(grasp)
            answers[kept] = [processor.process(shot.frame).angle_deg for shot in grasp.shots]
        differ += sum(one != other for one, other in zip(answers[True], answers[False], strict=True))
    saved = float(np.median(spent[False].busy_ms) - np.median(spent[True].busy_ms))
    how = f"{len(spent[True].busy_ms)} frames of plain round contacts; {differ} answers differ"
    return SkipResult("round: no thinning", True, saved, None, None, None, how)


SURER, OTHER = HoldingScene("wrench", 6000), HoldingScene("wrench", 6005, press=0.25, sign=-1.0)
"""The other finger's contact is faint: often too faint to tell an unchanged picture."""


@dataclass(slots=True)
class _FingerRun:
    """spent_s: on the second finger. seen: frames on which the law saw slip begin."""

    spent_s: list[float] = field(default_factory=list)
    errors_deg: list[float] = field(default_factory=list)
    seen: list[int] = field(default_factory=list)
    spared: int = 0


def second_finger(default: BenchPipeline) -> SkipResult:
    """The minute with both fingers looked at, and with the second one spared."""
    runs = {True: _FingerRun(), False: _FingerRun()}
    surer = default.open(SURER.scene())
    others = {spare: default.open(OTHER.scene()) for spare in runs}
    detectors, slipping = dict.fromkeys(runs, SlipMemory()), dict.fromkeys(runs, False)
    last: dict[bool, Estimate | None] = dict.fromkeys(runs)
    refresh_s = PerceptionSettings().refresh_s
    for index, (shot, beside) in enumerate(zip(SURER.shots(), OTHER.shots(), strict=True)):
        left = surer.process(shot.frame)
        for spare, run in runs.items():
            own, frame = last[spare], beside.frame
            start_s = time.process_time()
            if spare and own is not None and second_finger_can_skip(own, left, frame.captured_at_s, refresh_s):
                right = repeat_estimate(own, frame.captured_at_s, frame.sequence)
                run.spared += 1
            else:
                right = others[spare].process(frame)
            run.spent_s.append(time.process_time() - start_s)
            last[spare] = right
            fused = fuse(left, right)
            if fused is None:
                continue
            if shot.compared and fused.rotation_deg is not None:
                run.errors_deg.append(abs(fused.rotation_deg - shot.rotation_deg))
            sight = look(detectors[spare], fused, PARAMS)
            detectors[spare] = sight.detector
            if sight.slipping and not slipping[spare]:
                run.seen.append(index)
            slipping[spare] = sight.slipping
    spared, plain = runs[True], runs[False]
    saved_ms = 1e3 * (float(np.mean(plain.spent_s)) - float(np.mean(spared.spent_s)))
    later = [one - other for one, other in zip(spared.seen, plain.seen, strict=False)]
    if len(spared.seen) < len(plain.seen):
        later.append(len(plain.spent_s))
    return SkipResult(
        "second finger adds nothing: its last answer",
        True,
        saved_ms * len(plain.spent_s) / max(spared.spared, 1),
        saved_ms,
        float(np.mean(spared.errors_deg) - np.mean(plain.errors_deg)),
        max(later, default=None),
        f"{spared.spared} of {len(plain.spent_s)} frames of the finger that is pressed less; {len(plain.seen)} slips",
    )
