"""Run trial families: for a limited time in one process, or the full list in parallel batches."""

from __future__ import annotations

import heapq
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from slipguard.errors import InputError
from slipguard.stress.drift_families import HOLD, TRACKING
from slipguard.stress.image_families import IMAGES, TEXTURES
from slipguard.stress.mask_families import DEGENERATE, RANDOM
from slipguard.stress.numeric_families import FLOATS, FUSION, TIMES
from slipguard.stress.product_functions import ProductFunctions
from slipguard.stress.shape_families import EQUIVARIANCE, NOISE, ROUNDS, SEAMS
from slipguard.stress.trial_family import FamilyResults, TrialFailure, TrialFamily, TrialFunction, generator
from slipguard.tools.parallel import Workers, each

FAMILIES: tuple[TrialFamily, ...] = (
    DEGENERATE, RANDOM, EQUIVARIANCE, NOISE, SEAMS, ROUNDS, FLOATS, FUSION, TIMES, TRACKING, HOLD, TEXTURES, IMAGES,
)  # fmt: skip


JUDGED_FROM = 60
"""So many trials or frames of a family, in any order of the list, tell whether it answers often enough."""


@dataclass(frozen=True, slots=True)
class StressOutcome:
    """All that was tried. families and notes go together."""

    seed: int
    spent_s: float
    families: tuple[TrialFamily, ...]
    results: tuple[FamilyResults, ...]

    @property
    def failed(self) -> bool:
        return any(results.counts for results in self.results) or bool(self.rarely_answering)

    @property
    def rarely_answering(self) -> tuple[TrialFailure, ...]:
        """The families that answered less often than they must."""
        found = []
        for family, results in zip(self.families, self.results, strict=True):
            asked = results.answers + results.declined
            if (
                family.min_answered_share
                and results.tried >= JUDGED_FROM
                and (not asked or results.answers < family.min_answered_share * asked)
            ):
                what = f"told {results.answers:,} of {asked:,} that were asked, at least {family.min_answered_share:.0%} is promised"
                found.append(TrialFailure(family.name, "limit", self.seed, what))
        return tuple(found)


def chosen(names: Sequence[str]) -> tuple[TrialFamily, ...]:
    """The families of these names, all for none. Raises InputError that lists the names."""
    known = {family.name: family for family in FAMILIES}
    for name in names:
        if name not in known:
            raise InputError(f"--only {name}: there are {', '.join(known)}")
    return tuple(known[name] for name in dict.fromkeys(names)) or FAMILIES


def full_hours(families: Sequence[TrialFamily]) -> float:
    """About how long the full list takes on one core."""
    return sum(family.full * family.cost_ms for family in families) / 3.6e6


def schedule(families: Sequence[TrialFamily]) -> Iterator[tuple[int, int]]:
    """(index of the family, number of its trial) for the full list; every family gets the same share of the time.

    Time is reckoned by `cost_ms`, not measured: the order is the same on every machine.
    """
    rotations = [(family.cost_ms, index, 0) for index, family in enumerate(families)]
    heapq.heapify(rotations)
    while rotations:
        used_ms, index, number = heapq.heappop(rotations)
        yield index, number
        if number + 1 < families[index].full:
            heapq.heappush(rotations, (used_ms + families[index].cost_ms, index, number + 1))


def run(
    families: Sequence[TrialFamily],
    seed: int,
    seconds: float,
    product: ProductFunctions | None = None,
    progress: Callable[[float, str], None] | None = None,
    clock: Callable[[], float] = time.perf_counter,
) -> StressOutcome:
    """Run the list from its start until `seconds` are over, each family at least once.

    Trial k of a family has the seed `seed + k`. progress: called with the share of the time that is over and the name
    of the family that runs.
    """
    product = ProductFunctions() if product is None else product
    results = tuple(FamilyResults(family.name) for family in families)
    started_s = clock()
    with np.errstate(all="ignore"):  # what comes out is checked; an overflow on the way is no failure by itself
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
            try_one(family, begun[index], seed, number, results[index])
    return StressOutcome(seed, clock() - started_s, tuple(families), results)


def try_one(family: TrialFamily, trial: TrialFunction, seed: int, number: int, results: FamilyResults) -> None:
    """Trial `number` of a run that began at `seed`; what it lets through is a crash too."""
    results.seed = seed if family.continuous else seed + number
    results.call("trial", trial, generator(family.name, seed + number), seed + number, results)
    results.tried += family.frames


PART_MS = 10_000.0
"""How long a part takes, as reckoned: many parts keep all cores busy to the end, and little is lost by an interrupt."""


@dataclass(frozen=True, slots=True)
class TrialBatch:
    """Trials `first` to `after - 1` of a family."""

    family: TrialFamily
    first: int
    after: int

    def __str__(self) -> str:
        return f"{self.family.name}, trials {self.first} to {self.after - 1}"


def parts(families: Sequence[TrialFamily]) -> list[TrialBatch]:
    """The list cut up; every family gets on by the same share, one whose trials go on from each other is not cut."""
    cut: list[TrialBatch] = []
    for family in families:
        size = family.full if family.continuous else max(1, round(PART_MS / family.cost_ms))
        cut += [TrialBatch(family, first, min(first + size, family.full)) for first in range(0, family.full, size)]
    return sorted(cut, key=lambda part: part.first / part.family.full)


def run_whole(
    families: Sequence[TrialFamily],
    seed: int,
    product: ProductFunctions | None = None,
    workers: Workers | None = None,
    progress: Callable[[float, str], None] = lambda share, name: None,
    clock: Callable[[], float] = time.perf_counter,
) -> Iterator[StressOutcome]:
    """Try all of it; yields all that has been found so far after each part, and so at last everything.

    Trial k of a family has the seed `seed + k`, whoever tries it. progress: called with the share done and the name of
    the family of the part that is through.
    """
    started_s = clock()
    found = {family.name: FamilyResults(family.name) for family in families}
    cut = parts(families)
    all_ms = sum(family.full * family.cost_ms for family in families)
    done_ms = 0.0
    for part, results in zip(cut, each(partial(_tried, seed, product), cut, workers), strict=True):
        found[part.family.name].merge(results)
        done_ms += (part.after - part.first) * part.family.cost_ms
        progress(done_ms / all_ms, part.family.name)
        yield StressOutcome(seed, clock() - started_s, tuple(families), tuple(found.values()))


def _tried(seed: int, product: ProductFunctions | None, part: TrialBatch) -> FamilyResults:
    results = FamilyResults(part.family.name)
    with np.errstate(all="ignore"):  # as in `run`
        trial = part.family.begin(ProductFunctions() if product is None else product)
        for number in range(part.first, part.after):
            try_one(part.family, trial, seed, number, results)
    return results
