"""One trial of `slipguard stress`: a perturbed grasp through the pipeline and the finger fusion, and its checks."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from slipguard.control.finger_fusion import FusedEstimate, fuse
from slipguard.devices import Frame
from slipguard.errors import SlipguardError
from slipguard.perception.estimate import Estimate
from slipguard.perception.pipeline import ContactSegmenter, Pipeline
from slipguard.perception.segmenter import Segmenter
from slipguard.perception.settings import PerceptionSettings
from slipguard.perception.skipping import Skips
from slipguard.stress.grasps import Map, StressedGrasp
from slipguard.stress.perturbations import PERTURBATIONS
from slipguard.tools.experiment import Case

FailureKind = Literal["crash", "nan", "confident wrong", "limit"]
WRONG_SIGMAS = 4.0
"""An estimate is confident and wrong beyond this many of its own sigmas, however small the error is."""
CLAIM_SIGMAS, CLAIM_DEG = 3.0, 3.0
"""Where no rotation is visible, an estimated rotation beyond both is wrong."""
DRIFT_DEG = 0.1
DRIFT_FRAMES = 10
ODD_NUMBERS = (math.nan, math.inf, -math.inf, 1e308, -1e308, 5e-324, 0.0, -0.0, 1e-300, 1e18, -1e18)
FUSED_FIELDS = ("rotation_deg", "sigma_deg", "rate_deg_s", "shift_mm", "captured_at_s", "measured_at_s")


@dataclass(frozen=True, slots=True)
class ProductFunctions:
    """The product's functions under test. Tests replace them with faulty ones to show that the trials detect it."""

    pipeline: Callable[..., Any] = Pipeline
    fuse: Callable[[Estimate | None, Estimate | None], FusedEstimate | None] = fuse


@dataclass(slots=True)
class TrialOutcome:
    """What one trial found.

    Attributes:
        errors: (absolute error, sigma) in degrees of each estimate with a known truth.
        broken: Whether an estimate of a sweep was confidently wrong.
        drift_deg: Change of the mean error from the first frames to the last.
    """

    level: float
    estimated: int = 0
    declined: int = 0
    errors: list[tuple[float, float]] = field(default_factory=list)
    failures: list[tuple[FailureKind, str]] = field(default_factory=list)
    broken: bool = False
    drift_deg: float | None = None

    def fail(self, kind: FailureKind, what: str) -> None:
        self.failures.append((kind, what))

    def call(self, what: str, function: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
        """Return the function's result; None if it raised. A `SlipguardError` is allowed, any other is a crash."""
        try:
            return function(*arguments, **options)
        except SlipguardError:
            return None
        except Exception as error:
            self.fail("crash", f"{what}: {_location(error)}")
            return None

    def check_finite(self, what: str, *values: float | None) -> bool:
        """Return whether all values that are not None are finite; the others count as a failure."""
        odd = [value for value in values if value is not None and not math.isfinite(value)]
        if odd:
            self.fail("nan", f"{what}: {odd[0]}")
        return not odd

    def check_angle(self, what: str, angle_deg: float | None, sigma_deg: float | None, truth_deg: float | None,
                    *, sweep: bool = False) -> float | None:  # fmt: skip
        """Check one rotation against the truth.

        Args:
            truth_deg: None if no rotation is visible, so that none may be estimated with confidence.
            sweep: Whether a confident error is reported instead of failing.

        Returns:
            The signed error in degrees; None if it was declined, is invalid, or has no truth.
        """
        if angle_deg is None or sigma_deg is None:
            self.declined += 1
            if (angle_deg is None) != (sigma_deg is None):
                self.fail("limit", f"{what}: rotation {angle_deg} with sigma {sigma_deg}")
            return None
        self.estimated += 1
        if not self.check_finite(what, angle_deg, sigma_deg):
            return None
        if sigma_deg <= 0.0:
            self.fail("limit", f"{what}: sigma is {sigma_deg:g}°")
            return None
        if truth_deg is None:
            if abs(angle_deg) > max(CLAIM_DEG, CLAIM_SIGMAS * sigma_deg):
                self.fail("confident wrong", f"{what}: {angle_deg:+.2f}° ± {sigma_deg:.2f}°, no rotation is visible")
            return None
        error = angle_deg - truth_deg
        self.errors.append((abs(error), sigma_deg))
        if abs(error) > WRONG_SIGMAS * sigma_deg:
            self.broken = True
            if not sweep:
                self.fail("confident wrong", f"{what}: {angle_deg:+.2f}° ± {sigma_deg:.2f}°, true {truth_deg:+.2f}°")
        return error


class _ChangedSegmenter:
    """A segmenter whose probability maps are replaced."""

    def __init__(self, segmenter: ContactSegmenter, change: Callable[[Map], Map]) -> None:
        self._segmenter, self._change = segmenter, change
        self.threshold, self.input_size = segmenter.threshold, segmenter.input_size

    def segment(self, image: NDArray[np.uint8], background: NDArray[np.uint8] | None) -> Map:
        return self._change(self._segmenter.segment(image, background))


@cache
def _segmenter() -> Segmenter:
    return Segmenter()


def run_trial(case: Case[ProductFunctions]) -> TrialOutcome:
    """Run one trial: a perturbation, by name, of the grasp and with the level that follow from the seed."""
    row = PERTURBATIONS[case.name]
    rng = np.random.default_rng(np.random.SeedSequence([case.seed, *case.name.encode()]))
    outcome = TrialOutcome(row.level(case.seed))
    with np.errstate(all="ignore"):  # results are checked; an intermediate overflow is not a failure
        grasp = row.perturb(outcome.level, rng)
        estimates = _process(grasp, case, outcome, sweep=row.sweep, drift=row.drift)
        for estimate, truth_deg in estimates:
            _check_fusion(estimate, truth_deg, rng, case.parameters, outcome, sweep=row.sweep)
    return outcome


def _process(
    grasp: StressedGrasp, case: Case[ProductFunctions], outcome: TrialOutcome, *, sweep: bool, drift: bool
) -> list[tuple[Estimate, float | None]]:
    """Process the frames and check each rotation since the reference; return the estimates with their truth."""
    segmenter: ContactSegmenter = _segmenter()
    skips = Skips()
    if grasp.change_map is not None:
        segmenter, skips = _ChangedSegmenter(segmenter, grasp.change_map), Skips(unchanged=False, whole=False)
    settings = PerceptionSettings(reference="stable" if grasp.change_map is None else "first")
    pipeline = outcome.call(
        "pipeline", case.parameters.pipeline, segmenter, settings, grasp.background, grasp.noise_bgr, grasp.px_per_mm,
        skips=skips,
    )  # fmt: skip
    found: list[tuple[Estimate, float | None]] = []
    errors: list[float] = []
    reference_deg: float | None = None
    for number, (image, at_s, truth) in enumerate(zip(grasp.frames, grasp.times_s, grasp.rotations_deg, strict=True)):
        frame = Frame(image, at_s, number)
        estimate = None if pipeline is None else outcome.call("pipeline", pipeline.process, frame)
        if reference_deg is None and pipeline is not None and pipeline.has_reference:
            reference_deg = truth
        if estimate is None:
            continue
        since = None if truth is None else truth - (reference_deg or 0.0)
        outcome.check_finite("pipeline", estimate.orientation_deg, estimate.rate_deg_s, *(estimate.shift_mm or ()))
        error = outcome.check_angle("pipeline", estimate.rotation_deg, estimate.sigma_deg, since, sweep=sweep)
        if error is not None:
            errors.append(error)
        found.append((estimate, since))
    if drift and len(errors) > 2 * DRIFT_FRAMES:
        outcome.drift_deg = float(abs(np.mean(errors[-DRIFT_FRAMES:]) - np.mean(errors[:DRIFT_FRAMES])))
        if outcome.drift_deg > DRIFT_DEG:
            outcome.fail("limit", f"drift of {outcome.drift_deg:.3f}°, the limit is {DRIFT_DEG}°")
    return found


def _check_fusion(
    estimate: Estimate, truth_deg: float | None, rng: np.random.Generator, product: ProductFunctions,
    outcome: TrialOutcome, *, sweep: bool,
) -> None:  # fmt: skip
    """Fuse an estimate with that of an opposite finger, then with one that has an odd number in one field."""
    turned = None if estimate.rotation_deg is None else -estimate.rotation_deg
    other = replace(estimate, rotation_deg=turned)
    fused = outcome.call("fusion", product.fuse, estimate, other)
    known = TrialOutcome(outcome.level)
    if fused is not None and fused.rotation_deg is not None and estimate.rotation_deg is not None:
        known.check_angle("fusion", fused.rotation_deg, fused.sigma_deg, estimate.rotation_deg)
    name, odd = str(rng.choice(FUSED_FIELDS)), ODD_NUMBERS[int(rng.integers(len(ODD_NUMBERS)))]
    value: Any = (0.0, odd) if name == "shift_mm" else odd
    fused = outcome.call(f"fusion with {name} {odd:g}", product.fuse, estimate, replace(other, **{name: value}))
    if fused is not None:
        numbers = (fused.rotation_deg, fused.sigma_deg, fused.rate_deg_s, fused.shift_mm)
        finite = known.check_finite(f"fusion with {name} {odd:g}", *numbers, fused.captured_at_s, fused.measured_at_s)
        if finite and fused.sigma_deg is not None and fused.sigma_deg <= 0.0:
            known.fail("limit", f"fusion with {name} {odd:g}: sigma is {fused.sigma_deg:g}°")
    outcome.failures += known.failures


def _location(error: Exception) -> str:
    """Return an exception's type, the first line of its message, and where it was raised."""
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    lines = str(error).splitlines() or [""]
    where = "" if trace is None else f" at {Path(trace.tb_frame.f_code.co_filename).name}:{trace.tb_lineno}"
    return f"{type(error).__name__}: {lines[0][:120]}{where}"
