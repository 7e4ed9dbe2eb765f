"""Runs the families of trials in turns for as long as there is time, always in the same order."""

from __future__ import annotations

import heapq
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from slipguard.errors import InputError
from slipguard.stress.drift import TRACKING
from slipguard.stress.equivariance import EQUIVARIANCE
from slipguard.stress.family import Failure, Family, Notes, Trial, generator
from slipguard.stress.floats import FLOATS
from slipguard.stress.fusion import FUSION
from slipguard.stress.holding import HOLD
from slipguard.stress.images import PICTURES
from slipguard.stress.mask_trials import DEGENERATE, RANDOM
from slipguard.stress.noise import NOISE
from slipguard.stress.product_functions import Subject
from slipguard.stress.rounds import ROUNDS
from slipguard.stress.seams import SEAMS
from slipguard.stress.textures import TEXTURES
from slipguard.stress.times import TIMES

FAMILIES: tuple[Family, ...] = (
    DEGENERATE, RANDOM, EQUIVARIANCE, NOISE, SEAMS, ROUNDS, FLOATS, FUSION, TIMES, TRACKING, HOLD, TEXTURES, PICTURES,
)  # fmt: skip


JUDGED_FROM = 60
"""So many trials or frames of a family, in any order of the list, tell whether it answers often enough."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """All that was tried. families and notes go together."""

    seed: int
    spent_s: float
    families: tuple[Family, ...]
    notes: tuple[Notes, ...]

    @property
    def failed(self) -> bool:
        return any(notes.counts for notes in self.notes) or bool(self.silent)

    @property
    def silent(self) -> tuple[Failure, ...]:
        """The families that answered less often than they must."""
        found = []
        for family, notes in zip(self.families, self.notes, strict=True):
            asked = notes.answers + notes.declined
            if family.told and notes.tried >= JUDGED_FROM and (not asked or notes.answers < family.told * asked):
                what = f"told {notes.answers:,} of {asked:,} that were asked, at least {family.told:.0%} is promised"
                found.append(Failure(family.name, "limit", self.seed, what))
        return tuple(found)


def chosen(names: Sequence[str]) -> tuple[Family, ...]:
    """The families of these names, all for none. Raises InputError that lists the names."""
    known = {family.name: family for family in FAMILIES}
    for name in names:
        if name not in known:
            raise InputError(f"--only {name}: there are {', '.join(known)}")
    return tuple(known[name] for name in dict.fromkeys(names)) or FAMILIES


def full_hours(families: Sequence[Family]) -> float:
    """About how long the full list takes on one core."""
    return sum(family.full * family.cost_ms for family in families) / 3.6e6


def schedule(families: Sequence[Family]) -> Iterator[tuple[int, int]]:
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
    families: Sequence[Family],
    seed: int,
    seconds: float,
    subject: Subject | None = None,
    progress: Callable[[float, str], None] | None = None,
    clock: Callable[[], float] = time.perf_counter,
) -> Outcome:
    """Run the list from its start until `seconds` are over, each family at least once.

    Trial k of a family has the seed `seed + k`. progress: called with the share of the time that is over and the name
    of the family that runs.
    """
    subject = Subject() if subject is None else subject
    notes = tuple(Notes(family.name) for family in families)
    started_s = clock()
    with np.errstate(all="ignore"):  # what comes out is checked; an overflow on the way is no failure by itself
        begun: dict[int, Trial] = {}
        for index, number in schedule(families):
            spent_s = clock() - started_s
            if spent_s >= seconds and len(begun) == len(families):
                break
            family = families[index]
            if progress is not None:
                progress(min(spent_s / seconds, 1.0), family.name)
            if index not in begun:
                begun[index] = family.begin(subject)
            try_one(family, begun[index], seed, number, notes[index])
    return Outcome(seed, clock() - started_s, tuple(families), notes)


def try_one(family: Family, trial: Trial, seed: int, number: int, notes: Notes) -> None:
    """Trial `number` of a run that began at `seed`; what it lets through is a crash too."""
    notes.seed = seed if family.continuous else seed + number
    notes.attempt("trial", trial, generator(family.name, seed + number), seed + number, notes)
    notes.tried += family.frames
