"""Run trial families for a limited time."""

from __future__ import annotations

import heapq
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from slipguard.errors import InputError
from slipguard.stress.axis_families import AXES
from slipguard.stress.drift_families import DRIFTING, HOLD
from slipguard.stress.effect_families import EFFECT_SWEEPS
from slipguard.stress.image_families import IMAGES, TEXTURES
from slipguard.stress.mask_families import DEGENERATE
from slipguard.stress.numeric_families import FLOATS, FUSION, TIMES
from slipguard.stress.product_functions import ProductFunctions
from slipguard.stress.trial_family import FamilyResults, TrialFailure, TrialFamily, TrialFunction, generator

FAMILIES: tuple[TrialFamily, ...] = (
    DEGENERATE, AXES, FLOATS, FUSION, TIMES, DRIFTING, HOLD, TEXTURES, IMAGES, EFFECT_SWEEPS,
)  # fmt: skip


MIN_JUDGED_TRIALS = 60
"""From this many trials or frames on, the share of answered estimates of a family is checked."""


@dataclass(frozen=True, slots=True)
class StressOutcome:
    """Results of a run: `results[k]` belongs to `families[k]`."""

    seed: int
    spent_s: float
    families: tuple[TrialFamily, ...]
    results: tuple[FamilyResults, ...]

    @property
    def failed(self) -> bool:
        return any(results.counts for results in self.results) or bool(self.rarely_answering)

    @property
    def rarely_answering(self) -> tuple[TrialFailure, ...]:
        """One failure for each family in which too many estimates were declined."""
        found = []
        for family, results in zip(self.families, self.results, strict=True):
            share = family.min_answered_share
            possible = results.estimated + results.declined
            too_few = not possible or results.estimated < share * possible
            if share and results.tried >= MIN_JUDGED_TRIALS and too_few:
                what = f"estimated {results.estimated:,} of {possible:,}, the minimum is {share:.0%}"
                found.append(TrialFailure(family.name, "limit", self.seed, what))
        return tuple(found)


def select_families(names: Sequence[str]) -> tuple[TrialFamily, ...]:
    """Return the families of these names, or all families if there are no names.

    Raises:
        InputError: If a name is unknown; the message lists the known ones.
    """
    known = {family.name: family for family in FAMILIES}
    for name in names:
        if name not in known:
            raise InputError(f"--only {name}: unknown family. Choose from {', '.join(known)}")
    return tuple(known[name] for name in dict.fromkeys(names)) or FAMILIES


def full_hours(families: Sequence[TrialFamily]) -> float:
    """Return the estimated time of the full list on one core, in hours."""
    return sum(family.full * family.cost_ms for family in families) / 3.6e6


def schedule(families: Sequence[TrialFamily]) -> Iterator[tuple[int, int]]:
    """Yield (index of the family, trial number) for the full list; every family gets the same share of the time.

    The time is that of `cost_ms`, not measured, so that the order is the same on every machine.
    """
    queue = [(family.cost_ms, index, 0) for index, family in enumerate(families)]
    heapq.heapify(queue)
    while queue:
        used_ms, index, number = heapq.heappop(queue)
        yield index, number
        if number + 1 < families[index].full:
            heapq.heappush(queue, (used_ms + families[index].cost_ms, index, number + 1))


def run(
    families: Sequence[TrialFamily],
    seed: int,
    seconds: float,
    product: ProductFunctions | None = None,
    progress: Callable[[float, str], None] | None = None,
    clock: Callable[[], float] = time.perf_counter,
) -> StressOutcome:
    """Run the list from its start for `seconds`, each family at least once.

    Trial k of a family has the seed `seed + k`. progress: called with the share of the time and the family's name.
    """
    product = ProductFunctions() if product is None else product
    results = tuple(FamilyResults(family.name) for family in families)
    started_s = clock()
    with np.errstate(all="ignore"):  # results are checked; an intermediate overflow is not a failure
        begun: dict[int, TrialFunction] = {}
        for index, number in schedule(families):
            spent_s = clock() - started_s
            if spent_s >= seconds and len(begun) == len(families):
                break
            family = families[index]
            if progress is not None:
                progress(min(spent_s / seconds, 1.0), family.name)
            if index not in begun:
                begun[index] = family.begin(product)
            run_trial(family, begun[index], seed, number, results[index])
    return StressOutcome(seed, clock() - started_s, tuple(families), results)


def run_trial(family: TrialFamily, trial: TrialFunction, seed: int, number: int, results: FamilyResults) -> None:
    """Run trial `number` of a run that began at `seed`; an exception that it does not catch is a crash, too."""
    results.seed = seed if family.continuous else seed + number
    results.call("trial", trial, generator(family.name, seed + number), seed + number, results)
    results.tried += family.frames
