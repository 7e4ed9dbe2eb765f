"""The whole list, in parts that several processes try at once; what is found adds up as it comes."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from slipguard.stress.family import FamilyResults, TrialFamily
from slipguard.stress.product_functions import ProductFunctions
from slipguard.stress.run import StressOutcome, try_one
from slipguard.tools.parallel import Workers, each

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
