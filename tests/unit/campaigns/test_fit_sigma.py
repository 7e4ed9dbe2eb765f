"""The fit of sigma's constants finds those that errors were drawn from, and counts what lies within."""

from __future__ import annotations

import numpy as np
import pytest
from slipguard.perception.rotation.texture_registration import TextureFit, TexturePose, sigma_deg

from tests.campaigns.fit_sigma import HEADROOM, RotationSample, fitted, within


def drawn(count: int, spread_share: float, seed: int) -> list[RotationSample]:
    """Return rotations with Gaussian errors of `spread_share` times the spread within the contact."""
    rng = np.random.default_rng(seed)
    out = []
    for k in range(count):
        spread = float(np.exp(rng.uniform(np.log(0.05), np.log(1.0))))
        fit = TextureFit(TexturePose(), spread, 0.0, float(rng.uniform(0.01, 0.05)), 8.0, 1.0, 0.0, 50.0)
        out.append(RotationSample(f"grasp {k % 20}", float(rng.normal(0.0, spread_share * spread)), fit))
    return out


def test_the_share_that_errors_were_drawn_from_is_found() -> None:
    for share in (0.5, 1.5):  # 0.86: Student's t in place of Gauss
        assert fitted(drawn(4000, share, 1))[0] == pytest.approx(0.86 * HEADROOM[0] * share, rel=0.12)


def test_shares_within_are_counted_by_grasp() -> None:
    found = drawn(400, 0.2, 2)
    assert within(found, 100.0) == pytest.approx(1.0)
    assert within(found, 1e-9) == pytest.approx(0.0, abs=0.01)
    wrong = [RotationSample("far off", 9.0, found[0].fit)] * 5
    assert within(found + wrong, 3.0) == pytest.approx(20 / 21, abs=0.01)
    assert sigma_deg(wrong[0].fit) < 1.0
