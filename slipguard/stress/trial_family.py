"""Trial families and their results: what was tried, what failed, how large the errors were."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, TypeVar

import numpy as np

from slipguard.errors import SlipguardError
from slipguard.stress.product_functions import ProductFunctions

FailureKind = Literal["crash", "nan", "confident wrong", "limit"]
FAILURE_KINDS: tuple[FailureKind, ...] = ("crash", "nan", "confident wrong", "limit")
WRONG_DEG = 3.0
"""Errors below this are never counted as confident and wrong."""
WRONG_SIGMAS = 5.0
CLAIM_SIGMAS = 3.0
"""A turn claimed where there is none to see counts from this many of its own sigmas on."""
KEPT_FAILURES = 20

Result = TypeVar("Result")


@dataclass(frozen=True, slots=True)
class TrialFailure:
    """One thing that went wrong. seed: `slipguard stress --only FAMILY --seed SEED` shows it again."""

    family: str
    kind: FailureKind
    seed: int
    what: str


@dataclass(slots=True)
class CurvePoint:
    """Errors (degrees, without sign) of all trials at one place of a sweep, and how many gave no answer."""

    errors_deg: list[float] = field(default_factory=list)
    declined: int = 0


class FamilyResults:
    """What one family's trials found. `seed` is that of the trial now running."""

    def __init__(self, family: str) -> None:
        self.family = family
        self.seed = 0
        self.tried = 0
        self.answers = 0
        self.declined = 0
        self.counts: Counter[FailureKind] = Counter()
        self.failures: list[TrialFailure] = []
        self.worst_deg: dict[str, float] = {}
        self.worst_sigmas: dict[str, float] = {}
        self.promises: dict[str, float] = {}
        self.curves: dict[str, dict[float, CurvePoint]] = {}

    def add_failure(self, kind: FailureKind, what: str) -> None:
        """Count a failure; the first of each kind and the first `KEPT_FAILURES` of all are kept with their seeds."""
        self.counts[kind] += 1
        if self.counts[kind] == 1 or len(self.failures) < KEPT_FAILURES:
            self.failures.append(TrialFailure(self.family, kind, self.seed, what))

    def call(self, what: str, function: Callable[..., Result], *arguments: object) -> Result | None:
        """The function's result. None after an error: one of `slipguard.errors` is an answer, any other a crash."""
        try:
            return function(*arguments)
        except SlipguardError:
            return None
        except Exception as error:
            self.add_failure("crash", f"{what}: {_place(error)}")
            return None

    def check_finite(self, what: str, *values: float | None) -> bool:
        """Whether all values that are given are finite; counts a NaN or an infinity."""
        for value in values:
            if value is not None and not math.isfinite(value):
                self.add_failure("nan", f"{what} is {value}")
                return False
        return True

    def check_angle(
        self,
        label: str,
        angle_deg: float | None,
        sigma_deg: float | None,
        truth_deg: float | None,
        *,
        axial: bool,
    ) -> float | None:
        """Judge one answer; its error in degrees without sign, or None where there is none to judge.

        truth_deg None: there is no turn to see, and none may be claimed. axial: angles equal modulo half a turn.
        """
        if angle_deg is None or sigma_deg is None:
            self.declined += 1
            if (angle_deg is None) != (sigma_deg is None):
                self.add_failure("limit", f"{label}: angle {angle_deg} with sigma {sigma_deg}")
            return None
        self.answers += 1
        if not self.check_finite(label, angle_deg, sigma_deg):
            return None
        if sigma_deg <= 0.0:
            self.add_failure("limit", f"{label}: sigma is {sigma_deg:g}°")
            return None
        error = angle_deg - (0.0 if truth_deg is None else truth_deg)
        error = abs(math.remainder(error, 180.0) if axial else error)
        sigmas = CLAIM_SIGMAS if truth_deg is None else WRONG_SIGMAS
        if error > WRONG_DEG and error > sigmas * sigma_deg:
            truth = "no turn to see" if truth_deg is None else f"true {truth_deg:+.2f}°"
            self.add_failure("confident wrong", f"{label}: {angle_deg:+.2f}° ± {sigma_deg:.2f}°, {truth}")
        if truth_deg is None:
            return None
        self.worst_deg[label] = max(self.worst_deg.get(label, 0.0), error)
        self.worst_sigmas[label] = max(self.worst_sigmas.get(label, 0.0), error / sigma_deg)
        return error

    def check_limit(self, what: str, value: float, at_most: float) -> None:
        """Keep the largest value, and count one above the promise (or not finite) as a failure."""
        if not self.check_finite(what, value):
            return
        self.promises[what] = max(self.promises.get(what, 0.0), float(value))
        if value > at_most:
            self.add_failure("limit", f"{what} is {value:.4g}, at most {at_most:g} is promised")

    def add_curve_point(self, curve: str, level: float, error_deg: float | None) -> None:
        """One error of a sweep; None where there was no answer."""
        at = self.curves.setdefault(curve, {}).setdefault(level, CurvePoint())
        if error_deg is None:
            at.declined += 1
        else:
            at.errors_deg.append(error_deg)

    def merge(self, later: FamilyResults) -> None:
        """Take in what later trials of the same family found."""
        self.tried += later.tried
        self.answers += later.answers
        self.declined += later.declined
        both = [*self.failures, *later.failures]
        firsts = {one.kind: one for one in reversed(both)}
        self.failures = [one for k, one in enumerate(both) if k < KEPT_FAILURES or one is firsts[one.kind]]
        self.counts += later.counts
        for mine, others in (
            (self.worst_deg, later.worst_deg),
            (self.worst_sigmas, later.worst_sigmas),
            (self.promises, later.promises),
        ):
            for what, value in others.items():
                mine[what] = max(mine.get(what, value), value)
        for curve, levels in later.curves.items():
            for place, level in levels.items():
                at = self.curves.setdefault(curve, {}).setdefault(place, CurvePoint())
                at.errors_deg += level.errors_deg
                at.declined += level.declined


TrialFunction = Callable[[np.random.Generator, int, FamilyResults], None]
"""Runs one trial: its own random numbers, its seed (which picks the case where cases are listed), the notes."""


@dataclass(frozen=True, slots=True)
class TrialFamily:
    """Trials of one kind, each a pure function of its seed.

    full: trials in the full list. cost_ms: what one trial takes on one core of a 2.5 GHz server; it sets the order in
    which families take turns, and the hours stated for the full list. begin: makes the trial function.
    frames: what one trial counts for (a stretch of frames counts each). continuous: each trial goes on where the last
    one ended, so that a failure is reproduced from the first seed on. told: the least share of what is asked that must
    be answered, for an estimator that says nothing is never wrong; judged once enough has been tried.
    """

    name: str
    about: str
    full: int
    cost_ms: float
    begin: Callable[[ProductFunctions], TrialFunction]
    frames: int = 1
    continuous: bool = False
    min_answered_share: float = 0.0


def generator(family: str, seed: int) -> np.random.Generator:
    """The random numbers of one trial."""
    return np.random.default_rng(np.random.SeedSequence([seed, *family.encode()]))


def _place(error: Exception) -> str:
    """Type, first line, and where it was raised."""
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    lines = str(error).splitlines() or [""]
    where = "" if trace is None else f" at {Path(trace.tb_frame.f_code.co_filename).name}:{trace.tb_lineno}"
    return f"{type(error).__name__}: {lines[0][:120]}{where}"
