"""Two fingers that say impossible things: missing, non-finite, huge, stale, contradicting estimates."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from slipguard.perception.estimate import Estimate
from slipguard.stress.family import FamilyResults, TrialFamily, TrialFunction
from slipguard.stress.product_functions import ProductFunctions

ODD = (math.nan, math.inf, -math.inf, 1e308, -1e308, 5e-324, 0.0, -0.0, 1e-300, 1e18, -1e18)


def _estimate(angle_deg: float | None, sigma_deg: float | None, rate_deg_s: float | None, at_s: float) -> Estimate:
    return Estimate(
        1, at_s, at_s, True, 4000, "fused", angle_deg=angle_deg, sigma_deg=sigma_deg, rate_deg_s=rate_deg_s,
        shift_mm=(0.1, -0.2),
    )  # fmt: skip


def _begin(product: ProductFunctions) -> TrialFunction:
    def trial(rng: np.random.Generator, seed: int, results: FamilyResults) -> None:
        rotation = float(rng.uniform(-120, 120))
        rate = float(rng.choice((0.0, 30.0, 300.0))) * float(rng.choice((-1.0, 1.0)))
        now_s = float(10.0 ** rng.uniform(-3, 9))
        pair: list[Estimate | None] = []
        for sign in (1.0, -1.0):
            late_s = float(rng.choice((0.0, 0.017, 0.05, 0.09, 3.0)))
            sigma = float(10.0 ** rng.uniform(-2, 1))
            seen = rotation - rate * late_s + sigma * float(rng.normal())
            said = rate + float(rng.normal()) * 5.0
            one = _estimate(sign * seen, sigma, sign * said if rng.random() < 0.8 else None, now_s - late_s)
            pair.append(None if rng.random() < 0.1 else one)
        fused = results.call("fusion", product.fuse, *pair)
        if fused is not None and fused.rotation_deg is not None:
            truth = rotation - rate * (now_s - fused.captured_at_s)
            results.check_angle("fusion", fused.rotation_deg, fused.sigma_deg, truth, axial=False)
        _check_odd(rng, pair, product, results)

    return trial


def _check_odd(
    rng: np.random.Generator, pair: list[Estimate | None], product: ProductFunctions, results: FamilyResults
) -> None:
    """One field of one finger is odd: what comes out is finite, and its sigma positive."""
    which = int(rng.integers(2))
    one = pair[which] or _estimate(1.0, 1.0, 0.0, 1.0)
    odd = ODD[int(rng.integers(len(ODD)))]
    field = ("angle_deg", "sigma_deg", "rate_deg_s", "shift_mm", "captured_at_s", "measured_at_s")[int(rng.integers(6))]
    value: Any = (0.0, odd) if field == "shift_mm" else odd
    broken = list(pair)
    broken[which] = replace(one, **{field: value})
    said = f"fusion with {field} {odd:g}"
    fused = results.call(said, product.fuse, *broken)
    if fused is None:
        return
    out = (
        fused.rotation_deg,
        fused.sigma_deg,
        fused.rate_deg_s,
        fused.shift_mm,
        fused.captured_at_s,
        fused.measured_at_s,
    )
    if results.check_finite(said, *out) and fused.sigma_deg is not None and fused.sigma_deg <= 0.0:
        results.add_failure("limit", f"{said}: sigma is {fused.sigma_deg:g}°")


FUSION = TrialFamily(
    "fusion",
    "two fingers with missing, odd, stale and contradicting estimates",
    200_000,
    0.18,
    _begin,
    min_answered_share=0.9,
)
