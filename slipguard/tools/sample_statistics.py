"""Figures of samples for reports, None if there are no samples."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray


def rounded(value: float | None, digits: int = 4) -> float | None:
    """Return the value with at most this number of decimals."""
    return None if value is None else round(float(value), digits)


def mean(values: Iterable[float]) -> float | None:
    """Return the mean."""
    samples = list(values)
    return float(np.mean(samples)) if samples else None


def quantile(values: Iterable[float], share: float) -> float | None:
    """Return the value below which this share of the samples lies, interpolated."""
    samples = list(values)
    return float(np.quantile(samples, share)) if samples else None


def percentiles_ms(times_s: Sequence[float] | NDArray[np.float64]) -> tuple[float, float]:
    """Return p50 and p99 in milliseconds. times_s: at least one."""
    p50, p99 = np.percentile(np.asarray(times_s), (50, 99)) * 1e3
    return float(p50), float(p99)
