"""The whole list, in parts that several processes try at once; what is found adds up as it comes."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from slipguard.stress.family import Family, Notes
from slipguard.stress.product_functions import Subject
from slipguard.stress.run import Outcome, try_one
from slipguard.tools.parallel import Workers, each

PART_MS = 10_000.0
"""How long a part takes, as reckoned: many parts keep all cores busy to the end, and little is lost by an interrupt."""


@dataclass(frozen=True, slots=True)
class Part:
    """Trials `first` to `after - 1` of a family."""

    family: Family
    first: int
    after: int

    def __str__(self) -> str:
        return f"{self.family.name}, trials {self.first} to {self.after - 1}"


def parts(families: Sequence[Family]) -> list[Part]:
    """The list cut up; every family gets on by the same share, one whose trials go on from each other is not cut."""
    cut: list[Part] = []
    for family in families:
        size = family.full if family.continuous else max(1, round(PART_MS / family.cost_ms))
        cut += [Part(family, first, min(first + size, family.full)) for first in range(0, family.full, size)]
    return sorted(cut, key=lambda part: part.first / part.family.full)


def run_whole(
    families: Sequence[Family],
    seed: int,
    subject: Subject | None = None,
    workers: Workers | None = None,
    progress: Callable[[float, str], None] = lambda share, name: None,
    clock: Callable[[], float] = time.perf_counter,
) -> Iterator[Outcome]:
    """Try all of it; yields all that has been found so far after each part, and so at last everything.

    Trial k of a family has the seed `seed + k`, whoever tries it. progress: called with the share done and the name of
    the family of the part that is through.
    """
    started_s = clock()
    found = {family.name: Notes(family.name) for family in families}
    cut = parts(families)
    all_ms = sum(family.full * family.cost_ms for family in families)
    done_ms = 0.0
    for part, notes in zip(cut, each(partial(_tried, seed, subject), cut, workers), strict=True):
        found[part.family.name].add(notes)
        done_ms += (part.after - part.first) * part.family.cost_ms
        progress(done_ms / all_ms, part.family.name)
        yield Outcome(seed, clock() - started_s, tuple(families), tuple(found.values()))


def _tried(seed: int, subject: Subject | None, part: Part) -> Notes:
    notes = Notes(part.family.name)
    with np.errstate(all="ignore"):  # as in `run`
        trial = part.family.begin(Subject() if subject is None else subject)
        for number in range(part.first, part.after):
            try_one(part.family, trial, seed, number, notes)
    return notes
