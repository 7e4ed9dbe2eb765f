"""Percentiles for a line of text."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def percentiles_ms(times_s: Sequence[float]) -> tuple[float, float]:
    """p50 and p99 in milliseconds. times_s: at least one."""
    p50, p99 = np.percentile(np.asarray(times_s), (50, 99)) * 1e3
    return float(p50), float(p99)


def spread(times_s: Sequence[float]) -> str:
    """p50 and p99 in words."""
    p50, p99 = percentiles_ms(times_s)
    return f"p50 {p50:.1f} ms, p99 {p99:.1f} ms"
