"""The fit of sigma's constants finds those that errors were drawn from, and its table counts what lies within."""

from __future__ import annotations

import numpy as np
import pytest

from slipguard.perception.gel_memory import ImprintMemory
from slipguard.perception.registration import Ghost, Registration, TexturePose
from tests.campaigns.fit_sigma import RotationSample, constants_in_use, fitted, table

SPREAD = ("registration", "SPREAD")


def drawn(count: int, spread: float, seed: int, effect: str = "clean") -> list[RotationSample]:
    """Return rotations with Gaussian errors of `spread` times the disagreement of the contact's parts."""
    rng = np.random.default_rng(seed)
    out = []
    for _ in range(count):
        parts_deg = float(np.exp(rng.uniform(np.log(0.1), np.log(1.0))))
        best = Registration(TexturePose(10.0), parts_deg, 0.0, 0.0, 0.0, 1.0, 50.0, Ghost(0.0, 0.01, 0.0))
        out.append(RotationSample(effect, 10.0 + float(rng.normal(0.0, spread * parts_deg)), best, ImprintMemory()))
    return out


@pytest.mark.parametrize("spread", [0.7, 3.0])
def test_the_share_that_errors_were_drawn_from_is_found(spread: float) -> None:
    before = constants_in_use()
    # Student's t in place of Gauss makes it a little smaller.
    assert fitted(drawn(800, spread, 1))[SPREAD] == pytest.approx(0.93 * spread, rel=0.12)
    assert constants_in_use() == before


def test_the_table_counts_what_is_declined_within_and_beyond() -> None:
    found = drawn(400, 1.0, 2)
    none = RotationSample("clean", 0.0, None, ImprintMemory())
    (line,) = table([*found, *[none] * 100], {**constants_in_use(), SPREAD: 1.0})
    assert "n   500" in line
    assert "declined 20.0%" in line
    (line,) = table(found, {**constants_in_use(), SPREAD: 1e-3})
    assert "declined  0.0%" in line
    assert float(line.split(" 4 ")[1].split("%")[0]) > 40.0
    assert table([none], constants_in_use()) == ["clean        n     1, all declined"]
