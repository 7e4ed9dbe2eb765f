"""Trial families and their results: what was tried, what failed, and how large the errors were."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, TypeVar

import numpy as np

from slipguard.errors import SlipguardError
from slipguard.perception.estimate import Estimate
from slipguard.stress.product_functions import ProductFunctions

FailureKind = Literal["crash", "nan", "confident wrong", "limit"]
PIPELINE_SIGMAS = 4.0
"""A rotation of the pipeline is confident and wrong beyond this many of its own sigmas, however small the error is."""
WRONG_DEG = 3.0
"""Smaller errors of single functions on drawn input never count as confident and wrong."""
WRONG_SIGMAS = 5.0
CLAIM_SIGMAS = 3.0
"""Where no rotation is visible, an estimated rotation of more than this many of its own sigmas is wrong."""
KEPT_FAILURES = 20

Result = TypeVar("Result")


@dataclass(frozen=True, slots=True)
class TrialFailure:
    """One failed check. `slipguard stress --only FAMILY --seed SEED` reproduces it."""

    family: str
    kind: FailureKind
    seed: int
    what: str


@dataclass(slots=True)
class CurvePoint:
    """Absolute errors in degrees of all trials at one level of a sweep, and the number of declined estimates."""

    errors_deg: list[float] = field(default_factory=list)
    declined: int = 0


class FamilyResults:
    """Results of the trials of one family.

    seed: of the current trial. broken_at: the smallest size of each swept effect at which an estimate was off by more
    than four of its sigmas.
    """

    def __init__(self, family: str) -> None:
        self.family = family
        self.seed = 0
        self.tried = 0
        self.estimated = 0
        self.declined = 0
        self.counts: Counter[FailureKind] = Counter()
        self.failures: list[TrialFailure] = []
        self.worst_deg: dict[str, float] = {}
        self.worst_sigmas: dict[str, float] = {}
        self.largest: dict[str, float] = {}
        self.broken_at: dict[str, float] = {}
        self.curves: dict[str, dict[float, CurvePoint]] = {}

    def add_failure(self, kind: FailureKind, what: str) -> None:
        """Count a failure. The first of each kind and the first `KEPT_FAILURES` are kept with their seeds."""
        self.counts[kind] += 1
        if self.counts[kind] == 1 or len(self.failures) < KEPT_FAILURES:
            self.failures.append(TrialFailure(self.family, kind, self.seed, what))

    def call(self, what: str, function: Callable[..., Result], *arguments: object) -> Result | None:
        """Return the function's result; None if it raised. A `SlipguardError` is allowed, any other is a crash."""
        try:
            return function(*arguments)
        except SlipguardError:
            return None
        except Exception as error:
            self.add_failure("crash", f"{what}: {_location(error)}")
            return None

    def check_finite(self, what: str, *values: float | None) -> bool:
        """Return whether all values that are not None are finite, and count a failure if not."""
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
        pipeline: bool = False,
    ) -> float | None:
        """Check one estimate against the truth.

        Args:
            truth_deg: None if no rotation is visible, so that none may be estimated with confidence.
            axial: Whether angles are equal modulo 180 degrees.
            pipeline: Whether it is a rotation of the pipeline.

        Returns:
            The absolute error in degrees; None if the estimate was declined, is invalid, or has no truth.
        """
        if angle_deg is None or sigma_deg is None:
            self.declined += 1
            if (angle_deg is None) != (sigma_deg is None):
                self.add_failure("limit", f"{label}: angle {angle_deg} with sigma {sigma_deg}")
            return None
        self.estimated += 1
        if not self.check_finite(label, angle_deg, sigma_deg):
            return None
        if sigma_deg <= 0.0:
            self.add_failure("limit", f"{label}: sigma is {sigma_deg:g}°")
            return None
        error = angle_deg - (0.0 if truth_deg is None else truth_deg)
        error = abs(math.remainder(error, 180.0) if axial else error)
        sigmas = CLAIM_SIGMAS if truth_deg is None else WRONG_SIGMAS
        least_deg, sigmas = (0.0, PIPELINE_SIGMAS) if pipeline and truth_deg is not None else (WRONG_DEG, sigmas)
        if error > least_deg and error > sigmas * sigma_deg:
            truth = "no rotation is visible" if truth_deg is None else f"true {truth_deg:+.2f}°"
            self.add_failure("confident wrong", f"{label}: {angle_deg:+.2f}° ± {sigma_deg:.2f}°, {truth}")
        if truth_deg is None:
            return None
        self.worst_deg[label] = max(self.worst_deg.get(label, 0.0), error)
        self.worst_sigmas[label] = max(self.worst_sigmas.get(label, 0.0), error / sigma_deg)
        return error

    def check_rotation(self, label: str, estimate: Estimate, truth_deg: float | None) -> float | None:
        """Check the rotation of a pipeline's estimate, as `check_angle` does, and that its other fields are finite."""
        self.check_finite("pipeline", estimate.orientation_deg, estimate.rate_deg_s, *(estimate.shift_mm or ()))
        return self.check_angle(label, estimate.rotation_deg, estimate.sigma_deg, truth_deg, axial=False, pipeline=True)

    def check_limit(self, what: str, value: float, at_most: float) -> None:
        """Keep the largest value, and count a failure if it exceeds the specified limit or is not finite."""
        if not self.check_finite(what, value):
            return
        self.largest[what] = max(self.largest.get(what, 0.0), float(value))
        if value > at_most:
            self.add_failure("limit", f"{what} is {value:.4g}, the limit is {at_most:g}")

    def add_curve_point(self, curve: str, level: float, error_deg: float | None) -> None:
        """Add one error of a sweep; None for a declined estimate."""
        point = self.curves.setdefault(curve, {}).setdefault(level, CurvePoint())
        if error_deg is None:
            point.declined += 1
        else:
            point.errors_deg.append(error_deg)


TrialFunction = Callable[[np.random.Generator, int, FamilyResults], None]
"""Runs one trial: (random numbers, seed, results). The seed selects the case where a family has a list of cases."""


@dataclass(frozen=True, slots=True)
class TrialFamily:
    """Trials of one kind, each a pure function of its seed.

    Attributes:
        full: Number of trials in the full list.
        cost_ms: Time of one trial on one core of a 2.5 GHz server. It sets the order of the families and the
            stated duration of the full list.
        begin: Makes the trial function.
        frames: Number of frames in one trial; each counts as one trial in the report.
        continuous: Whether each trial continues the one before; a failure is then reproduced from the first seed on.
        min_answered_share: Smallest allowed share of estimates that are not declined: an estimator that always
            declines is never wrong.
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
    return np.random.default_rng(np.random.SeedSequence([seed, *family.encode()]))


def _location(error: Exception) -> str:
    """Return an exception's type, the first line of its message, and where it was raised."""
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    lines = str(error).splitlines() or [""]
    where = "" if trace is None else f" at {Path(trace.tb_frame.f_code.co_filename).name}:{trace.tb_lineno}"
    return f"{type(error).__name__}: {lines[0][:120]}{where}"
