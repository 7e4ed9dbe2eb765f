"""What each skip is worth: time saved, error added, and how much later a slip is seen."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from slipguard.bench.cropping import known_patch
from slipguard.bench.error_tally import PipelineResults
from slipguard.bench.holding import HoldingResult, hold
from slipguard.bench.minute import HoldingScene
from slipguard.bench.onset import ROTATION_RATES_DEG_S, SLIDE_RATES_MM_S, SlipOnset, first_seen, later_by
from slipguard.bench.pipelines import BenchPipeline
from slipguard.bench.rows import SkipResult
from slipguard.bench.second_finger import second_finger
from slipguard.datasets.rendered_grasps import ROUND_PLAIN, render_grasp
from slipguard.perception.settings import ALL_SKIPS, Skips
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
        cropped = known_patch(default)
        found += [cropped] if cropped is not None else []
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
